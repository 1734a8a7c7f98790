"""`fmr example`: made-up scans that the other commands take, with a truth that fits them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.evaluation.datasets import read_dataset, recognised
from fmr_cli.io import read_cloud, read_poses, read_transform


def near(source: np.ndarray, target: np.ndarray, T: np.ndarray, within: float) -> float:
    return float((cKDTree(target).query(transform_points(T, source))[0] < within).mean())


def test_a_pair_lies_on_each_other_at_the_truth(tmp_path, fmr):
    done = fmr("example", "pair", "-o", tmp_path / "pair")
    assert done.returncode == 0, done.stderr
    a, b = (read_cloud(tmp_path / "pair" / f"scan_{x}.ply").points for x in "ab")
    assert near(a, b, read_transform(tmp_path / "pair/truth.txt"), 0.1) > 0.6
    table = tmp_path / "pair/pairs.csv"
    assert recognised([table]) == "pairs"
    assert len(read_dataset("pairs", [table]).pairs) == 1


def test_a_building(tmp_path, fmr):
    fmr("example", "building", "--scans", "3", "-o", tmp_path / "b", "-q")
    folder = tmp_path / "b"
    clouds = [read_cloud(folder / f"office_0{n}.ply").points for n in range(3)]
    poses = [read_transform(folder / f"office_0{n}.pose.txt") for n in range(3)]
    T = np.linalg.inv(poses[0]) @ poses[1]
    assert near(clouds[1], clouds[0], T, 0.1) > 0.3
    assert recognised([folder]) == "poses"


def test_a_drive_is_kittis(tmp_path, fmr):
    fmr("example", "drive", "--scans", "14", "-o", tmp_path / "d", "-q")
    poses = read_poses(tmp_path / "d/poses.txt")
    assert len(poses) == 14
    clouds = [read_cloud(tmp_path / f"d/velodyne/{n:06d}.bin").points for n in (0, 1)]
    assert near(clouds[1], clouds[0], np.linalg.inv(poses[0]) @ poses[1], 0.3) > 0.5
    assert recognised([tmp_path / "d"]) == "kitti"
    (pair,) = read_dataset("kitti", [tmp_path / "d"]).pairs
    assert (pair.source, pair.target) == ("000000", "000009")  # 1.01 m a step along a curve


def test_objects_are_for_experiments(tmp_path, fmr):
    fmr("example", "objects", "--scans", "3", "-o", tmp_path / "o", "-q")
    assert len(read_cloud(tmp_path / "o/object_02.ply")) == 8192
    assert recognised([tmp_path / "o"]) is None


def test_the_same_seed_gives_the_same_scans(tmp_path, fmr):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        fmr("example", "pair", "-o", tmp_path / name, "--seed", seed, "-q")
    a, b, c = ((tmp_path / name / "scan_a.ply").read_bytes() for name in "abc")
    assert a == b
    assert a != c


@pytest.mark.parametrize(
    ("arguments", "said"), [(("--scans", "41"), "has 40 at most"), ((), "is not empty, give a new folder")]
)
def test_bad_input_is_one_line(tmp_path, fmr, arguments, said):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_text("x")
    done = fmr("example", "building", "-o", tmp_path / "full", *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
