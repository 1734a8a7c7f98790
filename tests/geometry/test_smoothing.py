"""Roughness tells noise from shape, and points put onto their planes lie nearer to the surface."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.geometry.smoothing import NEAR, PROBES, local_planes, planes_through, roughness


def ball(noise: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    v = rng.normal(size=(6000, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True) + rng.normal(0, noise, (6000, 3))


def test_noise_is_rough_and_a_curved_surface_is_not() -> None:
    assert roughness(ball(0.0), 30).share < 0.05
    assert roughness(ball(0.05), 30).share > 0.15


def test_noise_has_the_points_own_length_and_a_bend_has_none() -> None:
    assert roughness(ball(0.01), 30).noise == pytest.approx(0.01, rel=0.3)
    assert roughness(10 * ball(0.01), 30).noise == pytest.approx(0.1, rel=0.3)
    assert roughness(ball(0.0), 30).noise == 0


def test_noise_does_not_grow_with_the_neighbourhood_and_shape_does() -> None:
    assert roughness(ball(0.05), 30).growth < 3**0.5
    sparse = roughness(ball(0.0)[:150], 30)  # ten neighbours see the bend
    assert sparse.share > 0.05
    assert sparse.growth > 2
    assert roughness(ball(0.0)[:20], 30).growth == np.inf


def test_points_come_nearer_to_the_surface() -> None:
    noisy = ball(0.03)
    put, normals, _ = local_planes(noisy, cKDTree(noisy), 30)
    off = [np.abs(np.linalg.norm(points, axis=1) - 1).mean() for points in (noisy, put)]
    assert off[1] < 0.5 * off[0]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


def test_points_that_lie_together_have_no_noise() -> None:
    """The deviation grows from nothing: no square of that is too large for a number."""
    found = roughness(np.repeat(ball(0.05)[:400], 10, axis=0), 30)
    assert found.growth > 1e200
    assert found.noise == 0


def test_the_small_neighbourhoods_are_those_looked_up_by_themselves() -> None:
    points = np.random.default_rng(4).normal(size=(2 * PROBES, 3)) * [1, 1, 0.05]
    deviation, radius = planes_through(points[::2], cKDTree(points), NEAR)[2:]
    assert roughness(points, 30).share == pytest.approx(np.median(deviation / radius))
