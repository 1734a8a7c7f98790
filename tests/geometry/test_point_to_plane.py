"""Point-to-plane within a subgroup or with a scale, and its derivative."""

from __future__ import annotations

import numpy as np
import pytest
from simulation import turn_and_shift

from fmr_cli.cloud import transform_points
from fmr_cli.geometry import point_to_plane
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.pose_error import pose_error

Scans = tuple[np.ndarray, np.ndarray]
EDGE = 0.08  # of the voxels, metres


@pytest.mark.parametrize("dof", ["yaw", "translation", "planar"])
def test_a_constrained_polish_is_exact_and_stays_in_its_subgroup(room_scans: Scans, dof: str) -> None:
    basis = Motion(dof).basis()  # type: ignore[arg-type]
    truth = turn_and_shift(0 if dof == "translation" else 3, 0.0, (0.0, 0.0, 1.0))
    truth[:2, 3] = 0.06, -0.04
    truth[2, 3] = 0 if dof == "planar" else 0.05
    source = (room_scans[0] - truth[:3, 3]) @ truth[:3, :3]
    T = point_to_plane.constrained(source, room_scans[1], np.eye(4), EDGE, basis, scale=False)
    degrees, metres = pose_error(T, truth, (1.0, 1.0, 1.0))
    assert degrees < 0.1
    assert metres < 0.01
    np.testing.assert_allclose(T[2, :3], [0, 0, 1], rtol=0, atol=1e-14)
    if dof == "translation":
        assert np.array_equal(T[:3, :3], np.eye(3))
    if dof == "planar":
        assert abs(T[2, 3]) < 1e-14


def test_the_scale_is_found(room_scans: Scans) -> None:
    basis = Motion().basis()
    source = room_scans[0] / 1.02
    T = point_to_plane.constrained(source, room_scans[0], np.eye(4), EDGE, basis, scale=True)
    assert np.cbrt(np.linalg.det(T[:3, :3])) == pytest.approx(1.02, abs=2e-4)


def test_nothing_in_reach_leaves_the_pose(room_scans: Scans) -> None:
    T = turn_and_shift(10, 100.0)
    assert np.array_equal(point_to_plane.constrained(room_scans[0], room_scans[1], T, EDGE, Motion().basis(), False), T)


def test_the_derivative_is_that_of_central_differences() -> None:
    x, y, n = np.random.default_rng(0).normal(size=(3, 50, 3))
    pivot, h = np.array([1.0, -2.0, 0.5]), 1e-6

    def residuals(step: np.ndarray) -> np.ndarray:
        moved = transform_points(point_to_plane.step_motion(step, pivot), x)
        return point_to_plane.linearise(moved, y, n, pivot)[0]

    _, J = point_to_plane.linearise(x, y, n, pivot, scale=True)
    for row, step in zip(J, h * np.eye(7), strict=True):
        np.testing.assert_allclose((residuals(step) - residuals(-step)) / (2 * h), row, rtol=0, atol=1e-8)
