"""Baselines: each finds what it is made for, and one that is not installed is said with its remedy."""

from __future__ import annotations

import importlib
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.evaluation import baselines
from fmr_cli.evaluation.open3d_import import Open3DError, open3d
from fmr_cli.geometry.pose_error import pose_error

VOXEL = 0.05  # m, for rooms of some metres


def turned(points: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The points as a target, and T_target_source of the points themselves."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0, 0.02, np.radians(degrees)]).as_matrix(), [0.05, -0.03, 0.02]
    return transform_points(T, points), T


@pytest.mark.parametrize("baseline", [baselines.lm_icp, partial(baselines.gicp, voxel=VOXEL)])
def test_local_baselines_find_a_small_motion(room_scans, baseline):
    source = room_scans[0][:3000]
    target, T = turned(source, 3)
    assert pose_error(baseline(source, target), T)[0] < 0.5


@pytest.mark.parametrize("name", list(baselines.GLOBAL))
def test_global_baselines_find_any_motion(room_scans, name):
    there, missing = baselines.global_baselines(VOXEL)
    if name not in there:
        pytest.skip("; ".join(missing))
    target, T = turned(room_scans[0], 150)
    assert pose_error(there[name](room_scans[0], target), T)[0] < 3


@pytest.mark.parametrize("name", list(baselines.GLOBAL))
def test_a_sparse_cloud_has_a_grid_that_it_fills(name):
    """On twenty points a grid of a fiftieth of the extent has no neighbours; KISS-Matcher would end the process."""
    rng = np.random.default_rng(0)
    source, target = rng.uniform(-0.5, 0.5, (2, 20, 3))
    there, missing = baselines.global_baselines_at(partial(baselines.filled, 0.02))
    if name not in there:
        pytest.skip("; ".join(missing))
    assert there[name](source, target).shape == (4, 4)


def test_a_dense_cloud_keeps_the_edge_and_a_thinned_one_does_not():
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 3), -1).reshape(-1, 3)
    assert baselines.filled(3.0, grid, grid) == 3.0
    assert baselines.filled(3.0, 5 * grid, grid) == 10.0


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ModuleNotFoundError("No module named 'open3d'"), "pip install open3d"),
        (OSError("libGL.so.1: cannot open shared object file: No such file or directory"), "apt install libgl1$"),
        (ImportError("libusb-1.0.so.0: cannot open shared object file"), "apt install libusb-1.0-0$"),
        (OSError("something else"), "apt install libusb-1.0-0 libgl1 libegl1 libx11-6$"),
    ],
)
def test_what_open3d_lacks_is_one_line_with_its_remedy(monkeypatch, error, said):
    def fail(name):
        raise error

    monkeypatch.setattr(importlib, "import_module", fail)
    open3d.cache_clear()
    with pytest.raises(Open3DError, match=said) as raised:
        open3d()
    assert "\n" not in str(raised.value)
    there, missing = baselines.global_baselines(VOXEL)
    assert "FPFH + RANSAC" not in there
    assert any(line.startswith("no FPFH + RANSAC: Open3D") for line in missing)
