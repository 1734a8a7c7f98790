"""Scans as material: found, cut up, and what is no scan left out."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli import PointCloud, write_cloud
from fmr_cli.errors import FmrError
from fmr_cli.io.folders import find_scans
from fmr_cli.synthetic.shapes import others
from fmr_cli.training.scans import SCENE_CROPS, load_material, load_pairs, scene_crops


@pytest.fixture
def scan(tmp_path):
    def write(name, points=3000, seed=0):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_cloud(path, PointCloud(40 * others(1, points, seed)[0].astype(float) + [7e5, 5e6, 300]))
        return path

    return write


def test_folders_are_searched_and_tables_beside_scans_are_left_out(tmp_path, scan):
    a, b = scan("a.ply"), scan("deep/er/b.bin")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "notes.md").write_text("no scan")
    assert find_scans([tmp_path]) == [a, b]


def test_scans_that_are_tables_are_found_where_there_is_nothing_else(tmp_path, scan):
    assert find_scans([tmp_path, scan("only.xyz")]) == [tmp_path / "only.xyz"] * 2
    assert find_scans([scan("more/some.csv").parent]) == [tmp_path / "more/some.csv"]


def test_a_large_scan_is_cut_into_crops_of_several_scales(scan):
    material = load_material([scan("a.ply", 20_000)], crops=12, cloud_points=512, seed=0)
    assert material.clouds.shape == (12, 512, 3)
    assert material.clouds.dtype == np.float32
    assert abs(material.clouds).max((1, 2)) == pytest.approx(0.5)
    spreads = material.clouds.std((1, 2))
    assert spreads.std() > 0.005  # not the same cloud twelve times


def test_procedural_scenes_are_cut_up_like_scans_and_the_same_every_time():
    found = scene_crops(3, cloud_points=256, seed=5)
    assert len(found) == 3
    assert all(1 <= len(cut) <= SCENE_CROPS and cut.shape[1:] == (256, 3) for cut in found)
    assert all((a == b).all() for a, b in zip(found, scene_crops(3, cloud_points=256, seed=5), strict=True))


def test_unreadable_and_small_scans_are_skipped_and_said(tmp_path, scan):
    (tmp_path / "bad.ply").write_text("no ply")
    files = [tmp_path / "bad.ply", scan("small.ply", 40), scan("good.ply")]
    material = load_material(files, crops=6, cloud_points=256, seed=0)
    assert set(material.scan) == {2}
    assert [line.split(":")[0] for line in material.skipped] == [str(f) for f in files[:2]]


def test_nothing_to_train_on_is_one_line(tmp_path, scan):
    with pytest.raises(FmrError, match="no scan in there"):
        find_scans([tmp_path])
    with pytest.raises(FmrError, match=r"too small, 40 points where 256 are needed"):
        load_material([scan("small.ply", 40)], crops=6, cloud_points=256, seed=0)


def test_labelled_pairs_lie_on_each_other(tmp_path):
    rng = np.random.default_rng(0)
    target = rng.uniform(-3, 3, (4000, 3)) * [1, 1, 0.2]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 6, 7]
    write_cloud(tmp_path / "t.ply", PointCloud(target))
    write_cloud(tmp_path / "s.ply", PointCloud((target - T[:3, 3]) @ T[:3, :3]))
    np.savetxt(tmp_path / "T.txt", T)
    (tmp_path / "pairs.csv").write_text("source,target,transform\ns.ply,t.ply,T.txt\n")
    source, target = load_pairs(tmp_path / "pairs.csv", 1024, seed=0)
    assert source.shape == target.shape == (1, 1024, 3)
    assert abs(source[0].mean(0) - target[0].mean(0)).max() < 0.05
    assert source[0].std(0) == pytest.approx(target[0].std(0), rel=0.1)


@pytest.mark.parametrize(
    ("text", "said"),
    [("a,b\n1,2\n", "needs a first line"), ("source,target,transform\ns.ply,t.ply,\n", "line 2 lacks"), ("", "needs")],
)
def test_a_bad_list_of_pairs_is_one_line(tmp_path, text, said):
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(FmrError, match=said):
        load_pairs(tmp_path / "pairs.csv", 64, seed=0)
