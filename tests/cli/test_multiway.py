"""`fmr multiway`: a pose for each scan and a word on each link, whatever happens to the process."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest
from command import process_of
from rooms import room_views

from fmr_cli import PointCloud, read_cloud, write_cloud


@pytest.fixture(scope="module")
def clouds():
    return room_views(3, 4, 5_000)


@pytest.fixture(scope="module")
def scans(tmp_path_factory, clouds):
    """A folder with the folder of scans."""
    folder = tmp_path_factory.mktemp("network")
    (folder / "scans").mkdir()
    for n, points in enumerate(clouds[0]):
        grey = np.full(len(points), n, np.uint8)
        write_cloud(folder / "scans" / f"s{n}.ply", PointCloud(points, {"intensity": grey}))
    return folder


def copied(scans, folder):
    """The folder with the first three of the scans."""
    shutil.copytree(scans / "scans", folder / "scans", ignore=shutil.ignore_patterns("s3.ply"))
    return folder


@pytest.fixture
def folder(tmp_path, scans):
    return copied(scans, tmp_path)


RUN = ("multiway", "scans", "--aligned", "--anchor", "s2", "--merged", "all.ply", "--out", "out")


@pytest.fixture(scope="module")
def run(tmp_path_factory, fmr, scans):
    """One run that several tests look at: (its folder, what it said)."""
    folder = copied(scans, tmp_path_factory.mktemp("run"))
    return folder, fmr(*RUN, cwd=folder)


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def result(folder):
    """Everything a run has written but its times and its journal, by file."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in ("journal.jsonl", "network.json"))
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def test_what_is_written(run, clouds, worst_pose):
    folder, done = run
    assert done.returncode == 0, done.stderr
    assert "3 of 3 scans placed" in done.stderr
    scans = table(folder / "out" / "scans.csv")
    assert [row["scan"] for row in scans] == ["s0", "s1", "s2"]
    assert {row["status"] for row in scans} == {"placed"}
    assert {row["component"] for row in scans} == {"0"}
    poses = [np.loadtxt(folder / "out" / row["pose"]) for row in scans]
    assert np.array_equal(poses[2], np.eye(4))
    assert worst_pose(poses, clouds[1][:3]) < 0.03
    links = table(folder / "out" / "links.csv")
    assert {row["status"] for row in links} <= {"aligned", "uncertain", "failed", "rejected"}
    by_name = {row["scan"]: pose for row, pose in zip(scans, poses, strict=True)}
    for row in links:
        if row["status"] == "aligned":
            T = np.loadtxt(folder / "out" / row["transform"])
            network = np.linalg.inv(by_name[row["target"]]) @ by_name[row["source"]]
            assert np.linalg.norm((T - network)[:3, :3]) < 0.1
            assert float(row["residual_rot_deg"]) < 3
    network = json.loads((folder / "out" / "network.json").read_text())
    assert network["components"] == [{"anchor": "s2", "scans": ["s0", "s1", "s2"]}]
    g2o = (folder / "out" / "network.g2o").read_text().splitlines()
    assert sum(line.startswith("VERTEX_SE3:QUAT") for line in g2o) == 3
    assert all(len(line.split()) == 31 for line in g2o if line.startswith("EDGE_SE3:QUAT"))
    merged = read_cloud(folder / "all.ply")
    assert np.array_equal(merged.attributes["scan_id"], merged.attributes["intensity"])
    assert len(merged) == sum(map(len, clouds[0][:3]))
    moved = read_cloud(folder / "out" / "aligned" / "s1.ply")
    expected = clouds[0][1] @ poses[1][:3, :3].T + poses[1][:3, 3]
    assert np.allclose(moved.points, expected)


@pytest.fixture
def worst_pose():
    def worst(poses, truth):
        return max(
            np.linalg.norm((np.linalg.inv(poses[0]) @ T - np.linalg.inv(truth[0]) @ true)[:3, 3])
            for T, true in zip(poses, truth, strict=True)
        )

    return worst


def test_gtsam_reads_the_graph(run):
    import gtsam

    graph, values = gtsam.readG2o(str(run[0] / "out" / "network.g2o"), True)
    assert values.size() == 3
    found = gtsam.LevenbergMarquardtOptimizer(
        anchored(graph, values, gtsam), values
    ).optimize()  # moves little: the graph's links are those of the network
    for n in range(3):
        apart = values.atPose3(n).inverse().compose(found.atPose3(n)).translation()
        assert np.linalg.norm(apart) < 0.05


def anchored(graph, values, gtsam):
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    return graph


def started(folder, *extra, **given):
    """A run as a process of its own, with one worker, that hears Ctrl-C."""
    command = process_of(*RUN, "--workers", "1", *extra)
    unmasked = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **given}
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True, **unmasked)


def wait_for_lines(process, journal, count):
    while process.poll() is None and not (journal.exists() and journal.read_text().count("\n") >= count):
        time.sleep(0.01)


@pytest.mark.slow
def test_ctrl_c_and_a_kill_lose_no_link_and_resume_gives_the_same(fmr, folder, run):
    journal = folder / "out" / "journal.jsonl"
    process = started(folder)
    wait_for_lines(process, journal, 2)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130
    assert said.splitlines() == ["stopped; what is done is kept in out, --resume goes on"]
    stopped = journal.read_text().splitlines()
    assert len(stopped) >= 2
    process = started(folder, "--resume")
    wait_for_lines(process, journal, len(stopped) + 1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = journal.read_text().splitlines()
    assert len(kept) > len(stopped)
    assert kept[: len(stopped)] == stopped
    assert not (folder / "out" / "scans.csv").exists()
    refused = fmr(*RUN, cwd=folder)
    assert refused.returncode == 2
    assert "--resume" in refused.stderr
    assert fmr(*RUN, "--resume", "-q", cwd=folder).returncode == 0
    assert journal.read_text().splitlines()[: len(kept)] == kept, "what was done is not done again"
    assert not (folder / "out" / "work").exists()
    assert result(folder / "out") == result(run[0] / "out")


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_loses_nothing(fmr, folder):
    import resource

    def limited(size):
        """No file may grow beyond so many bytes, as on a disk that is full."""
        return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    journal = folder / "out" / "journal.jsonl"
    for size, file, extra in ((4_000, "journal.jsonl", ()), (100_000, "out/aligned/s0.ply", ("--resume",))):
        process = started(folder, *extra, preexec_fn=limited(size))
        said = process.communicate()[1]
        assert process.returncode == 2, said
        assert len(said.splitlines()) == 1
        assert f"{file}: cannot be written" in said
        assert not (folder / "all.ply").exists()
        kept = journal.read_bytes()
        kept = kept[: kept.rfind(b"\n") + 1]
        assert kept.count(b"\n") >= 2
    assert fmr(*RUN, "--resume", "-q", cwd=folder).returncode == 0
    assert journal.read_bytes().startswith(kept)


def test_resume_refuses_other_settings(fmr, run):
    folder, _ = run
    before = result(folder / "out")
    done = fmr(*RUN, "--resume", "--seed", "1", cwd=folder)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "other scans or settings" in done.stderr
    assert result(folder / "out") == before


@pytest.mark.slow
def test_what_cannot_be_joined_is_exit_code_3_and_said(fmr, folder):
    (folder / "scans" / "s2.ply").unlink()
    points = np.random.default_rng(0).normal(size=(2000, 3))
    write_cloud(folder / "scans" / "noise.ply", PointCloud(points))
    (folder / "scans" / "broken.ply").write_text("ply\n")
    done = fmr("multiway", "scans", "--out", "out", "--merged", "all.ply", "--merged-voxel", 0.2, cwd=folder)
    assert done.returncode == 3
    assert "not placed: noise" in done.stderr
    assert "broken failed" in done.stderr
    rows = {row["scan"]: row for row in table(folder / "out" / "scans.csv")}
    assert (rows["noise"]["status"], rows["noise"]["pose"], rows["noise"]["component"]) == ("unplaced", "", "")
    assert rows["broken"]["status"] == "failed"
    assert [rows[name]["status"] for name in ("s0", "s1")] == ["placed"] * 2
    assert 100 < len(read_cloud(folder / "all.ply")) < 10_000


BAD = {
    "one scan": (["scans/s0.ply"], "two or more"),
    "no such file": (["scans", "nowhere.ply"], "nowhere.ply"),
    "unknown anchor": (["scans", "--anchor", "s9"], "--anchor"),
    "unknown fixed": (["scans", "--fixed", "s9"], "--fixed"),
    "empty links": (["scans", "--links", "empty.csv"], "empty.csv"),
    "bad merged": (["scans", "--merged", "all.xyzw"], "all.xyzw"),
    "no folder": (["scans", "--out", "no/such"], "does not exist"),
}


@pytest.mark.parametrize(("arguments", "said"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_leaves_nothing(fmr, folder, arguments, said):
    (folder / "empty.csv").write_text("source,target\n")
    before = sorted(folder.rglob("*"))
    out = [] if "--out" in arguments else ["--out", "out"]
    done = fmr("multiway", *arguments, *out, cwd=folder)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr
    assert sorted(folder.rglob("*")) == before


@pytest.mark.slow
def test_contradictory_fixed_poses_are_said(fmr, folder, scans):
    """Two scans whose files lie anywhere are told to stay there: their link contradicts that, and is named."""
    shutil.copy(scans / "scans" / "s3.ply", folder / "scans")
    done = fmr("multiway", "scans", "--out", "out", "--fixed", "s0", "--fixed", "s1", cwd=folder)
    links = table(folder / "out" / "links.csv")
    pair = next(row for row in links if {row["source"], row["target"]} == {"s0", "s1"})
    assert pair["status"] == "rejected"
    assert "fixed" in pair["message"]
    assert "s1 to s0 is rejected" in done.stderr
    rows = {row["scan"]: row for row in table(folder / "out" / "scans.csv")}
    for name in ("s0", "s1"):
        assert np.array_equal(np.loadtxt(folder / "out" / rows[name]["pose"]), np.eye(4))
