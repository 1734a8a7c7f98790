"""Fixtures of all tests."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
from simulation import drive, make_street, scan

from fmr_cli import PointCloud, write_cloud

SHARED_DATA = Path(__file__).parents[1].parent / "shared" / "data"


def pytest_collection_finish() -> None:
    """Modules stay to the end: that the collector looks at them again and again took 3 % of the time."""
    gc.freeze()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans beside the repository; tests that need it are skipped where it is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real scans are not there: {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def room_scans() -> tuple[np.ndarray, np.ndarray]:
    """Two scans (12,000, 3) of one procedural room in its frame, metres, z up; 57 % of their points overlap."""
    from fmr_cli.synthetic import scenes

    rng = np.random.default_rng(1)
    room = scenes.room(rng)
    eye = np.array([0.0, 0.0, 1.4])
    walk = ((eye, 1.0), (eye + np.array([0.4, 0.3, 0.0]), 1.5))
    first, second = (rng.permutation(scenes.room_scan(room, rng, place, heading))[:12_000] for place, heading in walk)
    return first, second


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """A folder of KITTI .bin scans of a drive that is in motion from its first scan on, and the true poses."""
    folder = tmp_path_factory.mktemp("street")
    rng, place, poses = np.random.default_rng(1), make_street(60), drive(60, speed=4.0)[:8]
    for i, pose in enumerate(poses):
        points = scan(place, pose, rng, columns=450)
        write_cloud(folder / f"{i}.bin", PointCloud(points, {"intensity": np.full(len(points), i, np.float32)}))
    return folder, np.linalg.inv(poses[0]) @ poses


@pytest.fixture(scope="session")
def moving(tmp_path_factory):
    """PCD scans by a scanner that moves while it scans, on its way into a bend, and true poses of their middles."""
    folder, columns, start = tmp_path_factory.mktemp("moving"), 300, 18
    rng, place = np.random.default_rng(3), make_street(60)
    fine = drive(60, speed=8 / columns, turn=40 / columns, rest=0)[start * columns :]  # a pose a column
    for i in range(14):
        points = scan(place, fine[i * columns : (i + 1) * columns], rng, columns=columns)
        angle = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
        nanoseconds = np.uint64(17e17 + 1e8 * i) + (1e8 / (2 * np.pi) * angle).astype(np.uint64)
        write_cloud(folder / f"{i}.pcd", PointCloud(points, {"timestamp": nanoseconds}))
    middles = fine[columns // 2 :: columns][:14]
    return folder, np.linalg.inv(middles[0]) @ middles
