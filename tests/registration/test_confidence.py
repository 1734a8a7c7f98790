"""What the verdict promises: evidence without a unit, and confidences that share out one certainty."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration import confidence
from fmr_cli.registration.pipeline import align


def ball(rng: np.random.Generator, noise: float) -> np.ndarray:
    points = rng.normal(size=(8000, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [1, 0.8, 0.6] + rng.normal(0, noise, (8000, 3))


def pose(angle: float, shift: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[0, 3] = Rotation.from_rotvec([0, 0, angle], degrees=True).as_matrix(), shift
    return T


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_samples_of_one_surface_differ_as_neighbours_do_at_the_right_pose_alone(noise: float) -> None:
    rng = np.random.default_rng(0)
    source, target = (Surface(ball(rng, noise), 0.05) for _ in range(2))
    right, shifted, turned = (confidence.fit(source, target, T) for T in (np.eye(4), pose(0, 0.05), pose(15, 0)))
    assert right["overlap"] > 0.99
    assert max(right["offset"], right["turn"]) < 1.2
    assert min(shifted["offset"], turned["offset"]) > 1.3 * right["offset"]


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_evidence_has_no_unit(unit: float) -> None:
    rng = np.random.default_rng(0)
    a, b = ball(rng, 0.01), ball(rng, 0.01)
    here = confidence.fit(Surface(a, 0.05), Surface(b, 0.05), pose(10, 0.02))
    there = confidence.fit(Surface(a * unit, 0.05 * unit), Surface(b * unit, 0.05 * unit), pose(10, 0.02 * unit))
    for name, value in here.items():
        assert there[name] == pytest.approx(value * (unit if name == "inlier_rmse" else 1), rel=1e-3)


def test_nothing_in_reach_is_no_evidence() -> None:
    surface = Surface(ball(np.random.default_rng(0), 0), 0.05)
    far = confidence.fit(surface, surface, pose(0, 9.0))
    assert far["overlap"] == 0
    assert far["offset"] == far["turn"] == 1


def test_poses_that_fit_as_well_share_the_confidence() -> None:
    assert confidence.confidences([9.0]) == [pytest.approx(0.9)]
    assert confidence.confidences([9.0, 0.0]) == [pytest.approx(0.9), 0]
    assert confidence.confidences([9.0, 9.0]) == [pytest.approx(9 / 19)] * 2


def test_a_box_that_fits_turned_over_is_not_called_sure() -> None:
    rng = np.random.default_rng(1)
    sides = np.array([1.0, 0.6, 0.35])
    points = rng.uniform(-1, 1, (12_000, 3))
    points[np.arange(12_000), rng.choice(3, 12_000, p=(1 / sides) / (1 / sides).sum())] = rng.choice([-1, 1], 12_000)
    points = points * sides
    found = align(PointCloud(points[::2]), PointCloud(transform_points(pose(70, 1), points[1::2])))
    assert found.confidence < 0.6
    assert found.alternatives or found.status == "uncertain"


def test_a_sheet_is_found_by_its_outline() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (60_000, 3)) * [1, 1, 0]
    angle = np.arctan2(points[:, 1], points[:, 0])
    points = points[np.hypot(points[:, 0], points[:, 1]) < rng.uniform(0.3, 1, 24)[((angle + np.pi) * 3.8).astype(int)]]
    truth = pose(0, 1.0)
    truth[:3, :3] = Rotation.random(random_state=3).as_matrix()
    found = align(PointCloud(points[::2]), PointCloud(transform_points(truth, points[1::2])))
    error = np.linalg.inv(truth) @ found.T_target_source
    assert angle_degrees(error) < 1
    assert np.linalg.norm(error[:3, 3]) < 0.02
