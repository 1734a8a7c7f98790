"""Which motions are allowed, the starts among them, and the least squares motion between matched points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.search import STARTS
from fmr_cli.geometry.motion import Motion, rotations
from fmr_cli.geometry.pose_error import angle_between
from fmr_cli.geometry.se3 import exp

UP = (0.36, 0.48, 0.8)
DOFS = ["rigid", "yaw", "translation", "planar"]


def quaternions(T: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(T[:, :3, :3]).as_quat()


def largest_gaps(count: int, samples: int) -> np.ndarray:
    """The angle, in degrees, from each of many random rotations to the nearest start."""
    q = Rotation.random(samples, random_state=0).as_quat()
    return np.degrees(2 * np.arccos(np.minimum(np.abs(q @ quaternions(rotations(count)).T).max(1), 1)))


def test_the_starts_leave_no_rotation_further_than_61_degrees() -> None:
    gaps = largest_gaps(STARTS, 50_000)
    assert gaps.max() < 61
    assert gaps.mean() < 31
    q = quaternions(rotations(STARTS))
    apart = np.abs(q @ q.T - 2 * np.eye(STARTS)).max()
    assert math.degrees(2 * math.acos(min(apart, 1))) < 61


def test_more_starts_leave_smaller_gaps() -> None:
    few, more, most = (largest_gaps(n, 5_000).max() for n in (64, 512, 4096))
    assert more < 0.6 * few
    assert most < 0.6 * more


def test_starts_about_one_axis_are_even_and_keep_it() -> None:
    starts = Motion("yaw", UP).starts(64)[:, :3, :3]
    np.testing.assert_allclose(starts @ UP, np.tile(UP, (len(starts), 1)))
    np.testing.assert_allclose(angle_between(starts, np.roll(starts, 1, 0)), 2 * math.pi / len(starts))
    assert Motion("translation").starts(64).tolist() == [np.eye(4).tolist()]


@pytest.mark.parametrize(("dof", "freedom"), [("rigid", 6), ("yaw", 4), ("translation", 3), ("planar", 3)])
def test_the_basis_is_orthonormal_and_has_the_freedom_of_the_motion(dof: str, freedom: int) -> None:
    basis = Motion(dof, UP).basis()  # type: ignore[arg-type]
    assert basis.shape == (6, freedom)
    np.testing.assert_allclose(basis.T @ basis, np.eye(freedom), atol=1e-12)
    T = exp(basis @ np.random.default_rng(0).normal(size=freedom))
    if dof != "rigid":
        np.testing.assert_allclose(T[:3, :3] @ UP, UP)
    if dof == "planar":
        assert abs(T[:3, 3] @ UP) < 1e-12


def allowed(dof: str, lift: float) -> np.ndarray:
    twist = {"rigid": [0.7, -1.1, 2.0], "translation": [0.0, 0.0, 0.0]}.get(dof, 2.1 * np.array(UP))
    T = exp(np.array([*twist, 0.0, 0.0, 0.0]))
    T[:3, 3] = [1.0, -2.0, 0.5]
    if dof == "planar":
        T[:3, 3] += (lift - T[:3, 3] @ UP) * np.array(UP)
    return T


@pytest.mark.parametrize("dof", DOFS)
def test_the_fit_finds_the_motion_that_it_may(dof: str) -> None:
    T = allowed(dof, lift=0.3)
    x = np.random.default_rng(1).normal(size=(2, 40, 3))
    y = np.stack([transform_points(T, part) for part in x])
    y[:, :5] += 10  # wrong matches of no weight
    weight = np.ones((2, 40))
    weight[:, :5] = 0
    found = Motion(dof, UP, lift=0.3).fit(x, y, weight)  # type: ignore[arg-type]
    np.testing.assert_allclose(found, np.stack([T, T]), rtol=0, atol=1e-10)


@pytest.mark.parametrize("dof", DOFS)
def test_float32_rounding_is_put_right_within_the_subgroup(dof: str) -> None:
    T, motion = allowed(dof, 0.3), Motion(dof, UP, lift=0.3)  # type: ignore[arg-type]
    exact = motion.exact(T.astype(np.float32).astype(float))
    np.testing.assert_allclose(exact, T, rtol=0, atol=1e-6)
    R = exact[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=2e-15)
    if dof != "rigid":
        np.testing.assert_allclose(R @ UP, UP, rtol=0, atol=1e-15)
    if dof == "planar":
        assert abs(exact[:3, 3] @ UP - 0.3) < 1e-15


def test_flat_matches_are_turned_not_mirrored() -> None:
    x = np.random.default_rng(2).normal(size=(1, 20, 3)) * [1.0, 1.0, 0.0]
    y = x * [1.0, -1.0, 1.0]
    T = Motion().fit(x, y, np.ones((1, 20)))[0]
    np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1.0)
    np.testing.assert_allclose(transform_points(T, x[0]), y[0], rtol=0, atol=1e-9)


def test_points_that_all_share_are_fitted_as_those_that_each_has() -> None:
    rng = np.random.default_rng(5)
    source, target, weight = rng.normal(size=(1, 9, 3)), rng.normal(size=(1, 9, 3)), rng.random((4, 9))
    each = Motion().fit(np.repeat(source, 4, 0), np.repeat(target, 4, 0), weight)
    np.testing.assert_allclose(Motion().fit(source, target, weight), each, atol=1e-12)
