"""Point-to-plane within a subgroup or with a scale, and its derivative."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulation import turn_and_shift

from fmr_cli.cloud import transform_points
from fmr_cli.geometry import point_to_plane
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.normals import neighbours, normals_and_variation
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


def test_poses_side_by_side_have_the_equations_that_each_has_alone(room_scans: Scans) -> None:
    """Also where some have no partner in reach, and where the points of each pose are its own."""
    source, target = room_scans[0][:500], room_scans[1]
    tree = cKDTree(target)
    normals = normals_and_variation(target, *neighbours(target, tree))[0]
    T = np.array([turn_and_shift(angle, shift) for angle, shift in ((0, 0.0), (3, 0.02), (180, 0.5), (0, 99.0))])
    each = np.stack([source[:400], source[50:450], source[100:500], source[:400]])
    facing = normals[tree.query(each)[1]]
    together = point_to_plane.point_to_plane(each, target, normals, tree, T, EDGE, np.zeros(3), facing)
    for k in range(len(T)):
        alone = point_to_plane.point_to_plane(each[k], target, normals, tree, T[k], EDGE, np.zeros(3), facing[k])
        assert together.count[k] == alone.count
        for name in ("A", "b", "variance"):
            np.testing.assert_allclose(getattr(together, name)[k], getattr(alone, name), rtol=1e-9, atol=1e-12)
    assert together.count[0] > 200
    assert together.count[3] == 0
    assert not together.A[3].any()


def test_the_median_is_that_of_the_values_that_count() -> None:
    rng = np.random.default_rng(0)
    values, here = rng.normal(size=(9, 12)), rng.random((9, 12)) < 0.5
    here[0] = False
    here[1] = True
    expected = [np.median(v[h]) if h.any() else 0.0 for v, h in zip(values, here, strict=True)]
    assert np.array_equal(point_to_plane.median(values, here), expected)
    assert np.array_equal(point_to_plane.median(values[:, :0], here[:, :0]), np.zeros(9))
