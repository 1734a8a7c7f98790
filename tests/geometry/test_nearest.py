"""Distances to a cloud, looked up in an order of their own."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.geometry.nearest import NearestDistance, along_curve


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
