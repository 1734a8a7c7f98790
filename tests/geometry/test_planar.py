"""A 2-D scan is registered within its plane; a wall is no 2-D scan."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud, align
from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.geometry.planar import plane_of, raised, within_plane


def floor_plan(rng: np.random.Generator) -> np.ndarray:
    """Points along the walls of a room with alcoves, z = 0, metres."""
    corners = np.array([[0, 0], [6, 0], [6, 2], [4.5, 2], [4.5, 3], [6, 3], [6, 5], [2, 5], [2, 4], [0, 4], [0, 0]])
    u = rng.random((4000, 1))
    wall = rng.integers(0, len(corners) - 1, 4000)
    return np.column_stack([corners[wall] * (1 - u) + corners[wall + 1] * u, np.zeros(4000)])


def test_curves_in_a_plane_are_flat_and_a_filled_plane_is_not() -> None:
    rng = np.random.default_rng(0)
    plan = floor_plan(rng) - [3, 2.5, 0]
    np.testing.assert_allclose(np.abs(plane_of(plan)), [0, 0, 1], atol=1e-9)
    assert plane_of(rng.uniform(-1, 1, (4000, 3)) * [1, 1, 0]) is None
    assert plane_of(rng.normal(size=(4000, 3))) is None


def test_raised_points_stand_on_both_sides_of_their_plane() -> None:
    rng = np.random.default_rng(0)
    walls = raised(floor_plan(rng) - [3, 2.5, 0], np.array([0, 0, 1.0]), rng)
    assert walls[:, 2].min() == -walls[:, 2].max() < 0


def test_a_pose_is_kept_to_the_plane() -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.05, -0.1, 1.0]).as_matrix(), [1, 2, 0.3]
    flat = within_plane(T, np.array([0, 0, 1.0]), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(flat[2], [0, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(flat[:3, :3] @ flat[:3, :3].T, np.eye(3), atol=1e-12)


def test_two_scans_of_a_floor_plan_come_to_coincide() -> None:
    rng = np.random.default_rng(2)
    truth = np.eye(4)
    truth[:3, :3], truth[:2, 3] = Rotation.from_rotvec([0, 0, 1.2]).as_matrix(), [4, -2]
    found = align(PointCloud(floor_plan(rng)), PointCloud(transform_points(truth, floor_plan(rng))))
    assert angle_degrees(np.linalg.inv(truth) @ found.T_target_source) < 0.5
    np.testing.assert_allclose(found.T_target_source[:3, 3], truth[:3, 3], atol=0.05)
    assert found.undetermined == []
