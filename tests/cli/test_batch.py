"""`fmr batch`: a row a pair, whatever happens to the pairs or to the process."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest
from command import process_of

from fmr_cli import read_cloud, read_transform

MANIFEST = """source,target,name
a.ply,b.ply,
a.ply,missing.ply,
a.ply,b.ply,../first
b.ply,a.ply,../first
"""


def scans(folder, samples):
    """The folder with a manifest of two good pairs in both directions and a bad one, and the sample scans."""
    for name in "ab":
        shutil.copy(samples / f"scan_{name}.ply", folder / f"{name}.ply")
    (folder / "pairs.csv").write_text(MANIFEST)
    return folder


@pytest.fixture
def folder(tmp_path, samples):
    return scans(tmp_path, samples)


@pytest.fixture(scope="module")
def run(tmp_path_factory, samples, fmr_process):
    """A run of two workers that several tests look at: its folder, the process."""
    folder = scans(tmp_path_factory.mktemp("run"), samples)
    return folder, fmr_process(
        "batch", "pairs.csv", "--out", "out", "--aligned", "--merged", "--workers", 2, cwd=folder
    )


def rows(folder, out="out"):
    with (folder / out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def without_seconds(table):
    return [{name: value for name, value in row.items() if name != "seconds"} for row in table]


def test_a_row_for_each_pair_in_the_manifests_order(run, truth, pose_error):
    folder, done = run
    assert done.returncode == 3, done.stderr
    assert "3 aligned, 0 uncertain, 1 failed" in done.stderr
    table = rows(folder)
    assert [(row["source"], row["target"]) for row in table] == [
        ("a.ply", "b.ply"), ("a.ply", "missing.ply"), ("a.ply", "b.ply"), ("b.ply", "a.ply"),
    ]  # fmt: skip
    assert [row["status"] for row in table] == ["aligned", "failed", "aligned", "aligned"]
    assert "missing.ply" in table[1]["message"]
    assert table[1]["transform"] == ""
    for row, expected in zip([table[0], *table[2:]], [truth, truth, np.linalg.inv(truth)], strict=True):
        assert max(pose_error(read_transform(folder / "out" / row["transform"]), expected)) < 0.5
        assert float(row["seconds"]) > 0
        assert 0 < float(row["overlap"]) <= 1
    transforms = sorted(path.name for path in (folder / "out" / "transforms").iterdir())
    assert transforms == ["1_a_b.txt", "_first.txt", "_first_2.txt"], "every name is a safe one, and used once"
    assert "residual" in read_cloud(folder / "out" / "aligned" / "1_a_b.ply").attributes
    assert "source_id" in read_cloud(folder / "out" / "merged" / "1_a_b.ply").attributes


def test_the_same_results_with_one_worker_and_as_one_pair(run, fmr):
    folder, _ = run
    assert fmr("batch", "pairs.csv", "--out", "one", "--workers", 1, cwd=folder).returncode == 3
    assert without_seconds(rows(folder, "one")) == without_seconds(rows(folder))
    single = fmr("align", "a.ply", "b.ply", "-q", cwd=folder).stdout
    for out in ("one", "out"):
        assert (folder / out / "transforms/1_a_b.txt").read_text() == single
        assert (folder / out / "transforms/_first.txt").read_text() == single


@pytest.mark.slow
def test_a_kill_loses_no_row_and_resume_repeats_none(fmr, folder):
    (folder / "pairs.csv").write_text("source,target\n" + 4 * "a.ply,b.ply\n")
    process = subprocess.Popen(
        process_of("batch", "pairs.csv", "--out", "out", "--workers", "1"), cwd=folder, stderr=subprocess.DEVNULL
    )
    results = folder / "out" / "results.csv"
    while process.poll() is None and not (results.exists() and results.read_text().count("\n") >= 2):
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    whole = results.read_text()
    survived = rows(folder)[: whole.count("\n") - 1]
    assert 1 <= len(survived) < 4
    results.write_text(whole + "a.ply,b.p")  # what a kill in the middle of a row leaves

    assert fmr("batch", "pairs.csv", "--out", "out", cwd=folder).returncode == 2
    done = fmr("batch", "pairs.csv", "--out", "out", "--workers", "1", "--resume", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "4 aligned" in done.stderr
    assert rows(folder)[: len(survived)] == survived, "the rows that were there stay, their seconds too"
    assert len(rows(folder)) == 4
    again = results.read_bytes()
    assert fmr("batch", "pairs.csv", "--out", "out", "--resume", cwd=folder).returncode == 0
    assert results.read_bytes() == again


def test_resume_refuses_another_manifest_and_other_settings(fmr, folder):
    (folder / "pairs.csv").write_text("source,target\na.ply,missing.ply\n")
    (folder / "other.csv").write_text("source,target\nb.ply,missing.ply\n")
    assert fmr("batch", "pairs.csv", "--out", "out", cwd=folder).returncode == 3
    before = (folder / "out" / "results.csv").read_bytes()
    for arguments, said in ((["other.csv"], "manifest"), (["pairs.csv", "--seed", 1], "settings")):
        done = fmr("batch", *arguments, "--out", "out", "--resume", cwd=folder)
        assert done.returncode == 2
        assert said in done.stderr
    assert (folder / "out" / "results.csv").read_bytes() == before


def test_each_pair_may_have_its_own_start(fmr, folder, truth, samples):
    (folder / "starts").mkdir()
    np.save(folder / "starts" / "T.npy", truth)
    (folder / "pairs.csv").write_text("source, target, init\na.ply, b.ply, starts/T.npy\na.ply, b.ply, nowhere.txt\n")
    done = fmr("batch", folder / "pairs.csv", "--out", "out", "--workers", 1, cwd=folder)
    assert done.returncode == 3
    first, second = rows(folder)
    assert first["status"] == "aligned"
    assert second["status"] == "failed"
    assert "nowhere.txt" in second["message"]


BAD = {
    "no manifest": None,
    "empty": "",
    "no columns": "from,to\na.ply,b.ply\n",
    "no pair": "source,target\n",
    "no target": "source,target\na.ply,\n",
    "no text": "\0\1\2",
}


@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
def test_a_bad_manifest_is_one_line_and_leaves_nothing(fmr, tmp_path, text):
    if text is not None:
        (tmp_path / "pairs.csv").write_text(text)
    done = fmr("batch", "pairs.csv", "--out", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "pairs.csv" in done.stderr
    assert not (tmp_path / "out").exists()


def test_an_output_folder_without_a_parent(fmr, folder):
    done = fmr("batch", "pairs.csv", "--out", "no/such", cwd=folder)
    assert done.returncode == 2
    assert "does not exist" in done.stderr
