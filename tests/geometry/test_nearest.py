"""Distances to a cloud, looked up in an order of their own; many neighbours of a few points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.geometry.nearest import NearestDistance, along_curve, nearest_within
from fmr_cli.geometry.normals import neighbours, neighbours_of_all


def test_distances_are_exact_and_in_the_order_of_the_queries() -> None:
    rng = np.random.default_rng(0)
    points, queries = rng.normal(size=(5000, 3)) + 6e5, rng.normal(size=(3000, 3)) * 3 + 6e5
    np.testing.assert_allclose(NearestDistance(points)(queries), cKDTree(points).query(queries)[0], atol=1e-9)
    assert NearestDistance(points)(queries[:0]).shape == (0,)
    assert NearestDistance(points)(queries[:1]).shape == (1,)


def test_neighbours_on_the_curve_are_neighbours_in_space() -> None:
    points = np.random.default_rng(0).random((20_000, 3))
    order = along_curve(points)
    assert sorted(order) == list(range(20_000))
    step = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    assert step < 0.1 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


@pytest.mark.parametrize(("radius", "count"), [(0.05, 64), (0.4, 64), (1e-6, 3), (9.0, 500)])
def test_neighbours_within_a_radius_are_those_of_the_plain_search(radius: float, count: int) -> None:
    points = np.random.default_rng(0).random((500, 3)) * [1.0, 1.0, 0.01]
    tree = cKDTree(points)
    found, there = nearest_within(tree, points[::3] + 1e-3, radius, count)
    plain = tree.query(points[::3] + 1e-3, count, distance_upper_bound=radius)[1]
    assert np.array_equal(there, plain < len(points))
    assert np.array_equal(found, np.where(there, plain, 0))


def test_neighbours_of_all_are_those_of_the_plain_search() -> None:
    points = np.random.default_rng(0).random((500, 3))
    for some in (points, points[:12]):  # fewer points than neighbours
        for found, plain in zip(neighbours_of_all(some), neighbours(some, cKDTree(some)), strict=True):
            np.testing.assert_allclose(found, plain, rtol=1e-14)
