"""Pairs near their pose: what is done to them is what is said, and the normals are those of the surface."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.geometry.normals import neighbours, normals_and_variation
from fmr_cli.synthetic import near_pairs, scenes, sensors
from fmr_cli.synthetic.near_pairs import Degraded, TwoSamples, near_pair
from fmr_cli.synthetic.scenes import BALL, CUBE, CYLINDER, Scene


@pytest.fixture(scope="module")
def samples() -> TwoSamples:
    return near_pairs.made_up(np.random.default_rng(4), 1500)


@pytest.mark.parametrize("kind", [CUBE, BALL, CYLINDER])
def test_normals_are_at_right_angles_to_the_surface_of_a_stretched_solid(kind: int) -> None:
    scene, rng = Scene(), np.random.default_rng(kind)
    scene.add(kind, [1, 2, 3], [0.3, 0.6, 0.9], Rotation.random(random_state=rng))
    points = sensors.surface_scan(scene, rng, 3000).points
    tree = cKDTree(points)
    seen, variation = normals_and_variation(points, *neighbours(points, tree))[:2]
    smooth = variation < np.quantile(variation, 0.6)  # away from edges
    normals = scene.normals(points)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    assert (np.abs((normals * seen).sum(1))[smooth] > 0.98).mean() > 0.98
    assert (((points - [1, 2, 3]) * normals).sum(1) > 0).all()  # outward


def test_normals_of_a_scene_are_those_of_the_nearest_solid() -> None:
    scene = scenes.thing(np.random.default_rng(1))
    points = sensors.object_scan(scene, np.random.default_rng(1), np.eye(3), 160).points
    seen, variation = normals_and_variation(points, *neighbours(points, cKDTree(points)))[:2]
    smooth = variation < np.quantile(variation, 0.5)
    assert np.median(np.abs((scene.normals(points) * seen).sum(1))[smooth]) > 0.999


def test_noise_thinning_and_outliers_are_as_said(samples: TwoSamples) -> None:
    how = Degraded(noise=0.01, target_noise=0.02, density=0.5, outliers=0.2)
    pair = near_pair(samples, how, np.random.default_rng(0))
    half = samples.size / 2
    assert (len(pair.source), len(pair.target)) == (len(samples.source) // 2, len(samples.target))
    off = pair.target[: int(0.79 * len(pair.target))] - samples.target[: int(0.79 * len(pair.target))]
    assert off.std() == pytest.approx(0.02 * half, rel=0.05)
    home = transform_points(pair.T_target_source, pair.source)
    apart = cKDTree(samples.source).query(home)[0]
    count = round(0.8 * len(home))
    assert np.median(apart[:count]) < 0.02 * half
    assert np.median(apart[count:]) > 0.1 * half  # anywhere
    # Of the source's 0.4 n points and the target's 0.8 n
    ratio = len(samples.source) / len(samples.target)
    assert pair.variance == pytest.approx(half**2 * (0.01**2 + 0.02**2 * 0.5 * ratio), rel=0.01)


def test_a_start_is_near_and_the_common_points_lie_on_both(samples: TwoSamples) -> None:
    for seed in range(5):
        pair = near_pair(samples, Degraded(), np.random.default_rng(seed))
        off = pair.start @ np.linalg.inv(pair.T_target_source)
        assert 0 < angle_degrees(off) <= near_pairs.START_DEGREES
        middle = samples.target.mean(0)[None]
        assert np.linalg.norm(transform_points(off, middle) - middle) <= 1.001 * near_pairs.START_SHIFT * pair.size
        home = transform_points(pair.T_target_source, pair.source)
        assert cKDTree(home).query(pair.common)[0].max() < 1e-9 * pair.size
        assert len(pair.common) > 0.9 * len(home)
        assert pair.variance == 0


def test_two_sensors_see_much_in_common() -> None:
    for seed in range(4):
        samples = near_pairs.two_sensors(np.random.default_rng(seed), 800)
        pair = near_pair(samples, Degraded(0.01, 0.0), np.random.default_rng(seed))
        assert 0.3 < len(pair.common) / len(pair.source) <= 1
        assert pair.variance == pytest.approx((0.01 * samples.size / 2) ** 2)
