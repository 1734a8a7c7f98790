"""COPC: read as LAZ, or a part of space or of its levels alone; what is damaged is said."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from benchmarks.copc_file import write_copc
from fmr_cli.errors import CloudFileError
from fmr_cli.io import open_cloud, read_cloud, write_cloud

BOX = [600_010.0, 4_000_010, 50, 600_020, 4_000_050, 90]


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 100, (30_000, 3)) + np.array([600_000, 4_000_000, 50])


@pytest.fixture(scope="module")
def copc(tmp_path_factory: pytest.TempPathFactory, points: np.ndarray) -> Path:
    path = tmp_path_factory.mktemp("copc") / "a.copc.laz"
    write_copc(path, points)
    return path


def ordered(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def test_all_of_it_is_read_as_laz(copc: Path, points: np.ndarray) -> None:
    cloud = read_cloud(copc)
    assert np.abs(np.sort(cloud.points, axis=0) - np.sort(points, axis=0)).max() < 0.00051
    assert "intensity" in cloud.attributes


def test_bounds_and_resolution_give_what_laspy_gives(copc: Path) -> None:
    with laspy.CopcReader.open(copc) as reader:
        boxed = reader.query(bounds=laspy.copc.Bounds(np.array(BOX[:3]), np.array(BOX[3:])))
        coarse = reader.query(level=range(2))
    for cloud, expected in ((read_cloud(copc, bounds=BOX), boxed), (read_cloud(copc, resolution=10), coarse)):
        assert len(cloud) == len(expected)
        assert np.array_equal(ordered(cloud.points), ordered(np.stack([expected.x, expected.y, expected.z], 1)))
        assert cloud.attributes["intensity"].sum() == expected.intensity.sum()


def test_only_the_coarse_levels_are_read_where_fewer_points_are_enough(copc: Path) -> None:
    assert sum(map(len, open_cloud(copc, enough=500))) == 1000
    cloud = read_cloud(copc, at_most=5000)
    assert (len(cloud), cloud.count) == (9000, 30_000)


def test_other_formats_have_bounds_and_no_levels(tmp_path: Path, copc: Path, points: np.ndarray) -> None:
    cloud = read_cloud(copc)
    assert "COPC" in write_cloud(tmp_path / "a.laz", cloud)[0]
    write_cloud(tmp_path / "a.ply", cloud)
    for name in ("a.laz", "a.ply"):
        assert len(read_cloud(tmp_path / name, bounds=BOX)) == len(read_cloud(copc, bounds=BOX))
        with pytest.raises(CloudFileError, match="has no levels, --resolution needs a COPC"):
            read_cloud(tmp_path / name, resolution=1.0)
    with pytest.raises(CloudFileError, match="no points within the bounds"):
        read_cloud(copc, bounds=[0, 0, 0, 1, 1, 1])
    with pytest.raises(CloudFileError, match="give low x y z and then high"):
        read_cloud(copc, bounds=BOX[::-1])


def test_a_damaged_octree_is_said(tmp_path: Path, copc: Path) -> None:
    data = bytearray(copc.read_bytes())
    evlr = struct.unpack_from("<Q", data, 235)[0] + 60
    for at, value in ((evlr + 16, 1 << 60), (evlr + 16, 8), (evlr + 24, -5 & 0xFFFFFFFF), (evlr + 24, 9),
                      (evlr + 28, 0x7FFFFFFF), (evlr, 99)):  # fmt: skip
        spoilt = data.copy()
        struct.pack_into("<Q" if value >> 32 else "<I", spoilt, at, value)
        (tmp_path / "a.copc.laz").write_bytes(spoilt)
        with pytest.raises(CloudFileError, match="COPC"):
            read_cloud(tmp_path / "a.copc.laz", resolution=10)
