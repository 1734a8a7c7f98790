"""Which scans, what they are called, what is known of them, what stays in memory."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fmr_cli import FmrError, PointCloud, write_cloud
from fmr_cli.multiway import store
from fmr_cli.multiway.known import number_of, read_init_poses, read_links
from fmr_cli.multiway.links import Hypothesis, Journal, Link
from fmr_cli.multiway.scans import list_scans
from fmr_cli.registration import Options


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("day1/scan10.ply", "day1/scan2.ply", "day2/scan2.ply", "other.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_cloud(tmp_path / name, PointCloud(rng.normal(size=(60, 3))))
    return tmp_path


def test_files_folders_and_lists_in_natural_order(folder):
    (folder / "list.txt").write_text("# two of them\nother.ply\n")
    names = [scan.name for scan in list_scans([folder / "day1", folder / "list.txt"])]
    assert names == ["other", "scan2", "scan10"]


def test_folders_tell_equal_stems_apart(folder):
    assert [scan.name for scan in list_scans([folder])] == ["day1_scan2", "day2_scan2", "other", "scan10"]


def test_what_a_run_has_written_is_no_scan(folder):
    (folder / "out" / "aligned").mkdir(parents=True)
    write_cloud(folder / "out" / "aligned" / "scan10.ply", PointCloud(np.eye(3)))
    assert len(list_scans([folder], folder / "out")) == 4


def test_a_scan_is_found_by_name_file_and_path(folder):
    scans = list_scans([folder])
    for name in ("other", "other.ply", str(folder / "other.ply")):
        assert scans[number_of(name, scans, "--anchor")].name == "other"
    for name in ("scan2", "nowhere"):
        with pytest.raises(FmrError, match=f"--anchor: no scan is called {name}"):
            number_of(name, scans, "--anchor")


BAD_LINKS = {
    "empty": "",
    "no line": "source,target\n",
    "no columns": "from,to\na,b\n",
    "no target": "source,target\na,\n",
    "unknown use": "source,target,use\na,b,maybe\n",
    "known without a transform": "source,target,use\na,b,known\n",
    "too few numbers": "source,target,transform\na,b,1 0 0 0 1 0\n",
    "a scale": "source,target,transform\na,b,2 0 0 0 0 2 0 0 0 0 2 0\n",
    "no rotation": "source,target,transform\na,b,1 0 0 0 0 1 0 0 0 0 -1 0\n",
}


@pytest.mark.parametrize("text", BAD_LINKS.values(), ids=BAD_LINKS)
def test_bad_links_are_one_line_that_names_the_file(tmp_path, text):
    (tmp_path / "links.csv").write_text(text)
    with pytest.raises(FmrError, match=r"links\.csv") as error:
        read_links(tmp_path / "links.csv")
    assert "\n" not in str(error.value)


def test_links_and_poses_are_read(tmp_path):
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    np.savetxt(tmp_path / "T.txt", T)
    (tmp_path / "links.csv").write_text("source,target,use,transform\na,b,known,T.txt\na,c,never,\nb,c,,\n")
    links = read_links(tmp_path / "links.csv")
    assert [link.use for link in links] == ["known", "never", "try"]
    assert np.array_equal(links[0].T_target_source, T)
    (tmp_path / "poses.csv").write_text("scan,pose,sigma_shift\na,T.txt,0.5\nb,1 0 0 1 0 1 0 2 0 0 1 3,\n")
    poses = read_init_poses(tmp_path / "poses.csv")
    assert np.array_equal(poses["a"].T_world_scan, poses["b"].T_world_scan)
    assert (poses["a"].sigma_shift, poses["b"].sigma_shift) == (0.5, None)
    for text, said in (("a,T.txt,-1\n", "sigma_shift"), ("a,T.txt,\na,T.txt,\n", "already")):
        (tmp_path / "poses.csv").write_text("scan,pose,sigma_shift\n" + text)
        with pytest.raises(FmrError, match=said):
            read_init_poses(tmp_path / "poses.csv")


def test_memory_is_bounded_and_a_large_file_is_read_once(folder, monkeypatch):
    read = []
    monkeypatch.setattr(store, "CACHED_POINTS", 130 + 2 * store.PREPARED)
    monkeypatch.setattr(store, "SPILLED", 50)
    original = store.read_cloud
    monkeypatch.setattr(store, "read_cloud", lambda path, **given: read.append(path.name) or original(path, **given))
    scans = list_scans([folder])
    kept = store.Store(scans, 0, folder / "work")
    first = [kept.prepared(n).points for n in (0, 1, 2, 3)]
    assert len(kept.kept) == 2
    assert np.array_equal(kept.prepared(0).points, first[0]), "the same from where it was spilled"
    assert len(read) == 4


def test_a_torn_line_of_the_journal_is_cut_off(tmp_path):
    journal = Journal(tmp_path / "j", {"a": 1})
    journal.begin()
    T = np.array([[0.1, 0.2, 0.3, 1 / 3]] * 3 + [[0, 0, 0, 1]])
    link = Link(1, 0, "aligned", "features", [Hypothesis(T, 0.9)], np.eye(6) / 7, 0.5, 0.1, 0.05, "said")
    journal.keep("1 0 features ", link)
    whole = (tmp_path / "j").read_bytes()
    (tmp_path / "j").write_bytes(whole + b'{"key": "2 0 fea')
    again = Journal(tmp_path / "j", {})
    assert again.read() == {"a": 1}
    assert (tmp_path / "j").read_bytes() == whole
    recalled = again.recall("1 0 features ")
    assert np.array_equal(recalled.T_target_source, T), "bit for bit"
    assert np.array_equal(recalled.information, link.information)
    assert again.recall("2 0 features ") is None
    assert json.loads(whole.splitlines()[0]) == {"a": 1}


def test_options_of_a_run_name_its_attempts():
    from fmr_cli.multiway.links import key_of

    T = np.eye(4)
    T[0, 3] = 0.1
    keys = {key_of(1, 0, "pose", Options(init=x)) for x in (np.eye(4), T)} | {key_of(1, 0, "auto", Options())}
    assert len(keys) == 3
