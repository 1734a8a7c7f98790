"""kill -9 and a full disk while a file is written: what was there before is there after, and nothing else stays."""

from __future__ import annotations

import os
import random
import subprocess
import time
from pathlib import Path

import command
import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.io import atomic_write, read_cloud, write_cloud, write_transform

resource = pytest.importorskip("resource")  # POSIX
OLD = b"what was there before"
QUICK = ("--init", "identity", "--voxel-size", 1, "--no-refine")  # what is written matters here, not the pose


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two files of so many points that writing takes a while, one of few, and a transform."""
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-20, 20, (2, 200_000))
    hills = zip(*rng.uniform(-20, 20, (2, 60)), rng.normal(0, 3, 60), rng.uniform(1, 4, 60), strict=True)
    z = sum(h * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * w**2)) for u, v, h, w in hills)  # nowhere like elsewhere
    points = np.column_stack([x, y, z])
    intensity = {"intensity": rng.integers(0, 999, len(x)).astype(np.uint16)}
    write_cloud(folder / "a.npz", PointCloud(points, intensity))
    write_cloud(folder / "b.npz", PointCloud(points[::-1], intensity))
    write_cloud(folder / "few.npz", PointCloud(points, intensity).select(slice(20_000)))
    T = np.eye(4)
    T[:3, 3] = [1, 2, 3]
    write_transform(folder / "T.txt", T)
    return folder


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if ".tmp" in path.name]


def killed_while_writing(arguments: list[str], folder: Path, delay: float) -> bool:
    """Starts the command, kills it ``delay`` seconds after its first temporary file has bytes; whether it was alive."""
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not any(p.stat().st_size for p in folder.rglob(".*.tmp*") if p.exists()):
            time.sleep(0.002)
        time.sleep(delay)
        alive = process.poll() is None
        process.kill()
    return alive


@pytest.mark.parametrize("suffix", [".ply", *(pytest.param(s, marks=pytest.mark.slow) for s in (".las", ".csv"))])
def test_transform_is_killed(scans: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"out{suffix}"
    out.write_bytes(OLD)
    arguments = ("transform", scans / "a.npz", scans / "T.txt", "-o", out)
    alive = killed_while_writing(command.process_of(*arguments), tmp_path, random.Random(suffix).uniform(0, 0.05))
    moved = np.array([1, 2, 3]) + read_cloud(scans / "a.npz").points.mean(0)
    if alive and leftovers(tmp_path):
        assert out.read_bytes() == OLD
    elif alive:  # killed after the whole file had taken its name, before the process ended
        assert read_cloud(out).points.mean(0) == pytest.approx(moved)
    assert command.here(*arguments).returncode == 0
    assert leftovers(tmp_path) == []
    assert read_cloud(out).points.mean(0) == pytest.approx(moved)


@pytest.mark.slow
def test_merged_is_killed(scans: Path, tmp_path: Path) -> None:
    out, pose = tmp_path / "out.ply", tmp_path / "T.txt"
    out.write_bytes(OLD)
    arguments = ("align", scans / "a.npz", scans / "b.npz", "-o", pose, *QUICK, "--merged", out, "-q")
    if killed_while_writing(command.process_of(*arguments), tmp_path, 0.0) and leftovers(tmp_path):
        assert out.read_bytes() == OLD
    assert command.here(*arguments).returncode in (0, 3)
    assert leftovers(tmp_path) == []
    assert len(read_cloud(out)) == 400_000


@pytest.mark.slow
def test_a_batch_is_killed_and_goes_on(scans: Path, tmp_path: Path) -> None:
    manifest, out = tmp_path / "pairs.csv", tmp_path / "out"
    rows = "".join(f"{scans}/a.npz,{scans}/b.npz,p{k}\n" for k in range(3))
    manifest.write_text(f"source,target,name\n{rows}")
    arguments = ("batch", manifest, "--out", out, "--aligned", "--workers", 1, "--quiet", "--resume", *QUICK)
    out.mkdir()
    killed_while_writing(command.process_of(*arguments), out / "aligned", 0.02)
    assert command.here(*arguments).returncode in (0, 3)
    assert leftovers(out) == []
    assert len((out / "results.csv").read_text().splitlines()) == 4
    assert sorted(p.name for p in (out / "aligned").iterdir()) == ["p0.npz", "p1.npz", "p2.npz"]


@pytest.mark.parametrize(
    "suffix", [".ply", ".pcd", ".las", ".laz", ".npz", ".npy", ".bin", ".csv", ".pts", ".ptx", ".e57"]
)
def test_a_full_disk(scans: Path, tmp_path: Path, suffix: str) -> None:
    """A file of more than 100 kB cannot be written: the same as far as a program can tell."""
    if suffix == ".e57":
        pytest.importorskip("pye57")
    out = tmp_path / f"out{suffix}"
    out.write_bytes(OLD)
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, unlimited[1]))  # Python ignores the signal: writing fails
    try:
        done = command.here("transform", scans / "few.npz", scans / "T.txt", "-o", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert f"{out}" in done.stderr
    assert out.read_bytes() == OLD
    assert leftovers(tmp_path) == []


def test_only_what_the_dead_have_left_is_removed(tmp_path: Path) -> None:
    out = tmp_path / "a.ply"
    with atomic_write(out) as mine:
        mine.write_bytes(b"1")
        name = mine.name
        with subprocess.Popen(["true"]) as process:
            process.wait()
        ended = subprocess.Popen(["true"])  # nobody asks how, so that the system still lists it
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
        dead = [tmp_path / name.replace(f"-{os.getpid()}-", f"-{pid}-") for pid in (process.pid, ended.pid)]
        for path in dead:
            path.write_bytes(b"2")
        others = [
            tmp_path / name.replace(".a.", ".ab."),
            tmp_path / f".a.{os.getpid()}.tmp.ply",
            tmp_path / "a.tmp.ply",
        ]
        for path in others:
            path.write_bytes(b"3")
        with atomic_write(out) as again:
            assert mine.exists()
            assert not dead[0].exists()
            assert dead[1].exists() == (not Path("/proc/self/stat").exists())  # only Linux can tell
            again.write_bytes(b"4")
    ended.wait()
    assert out.read_bytes() == b"1"
    assert all(path.exists() for path in others)
