"""Voxel keys: one number a voxel, the same in every cloud."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.geometry.voxels import Voxels, occupied_voxels, voxel_downsample, voxel_keys


def test_equal_keys_are_equal_voxels_in_the_order_of_their_indices() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (5000, 3))
    cells = np.floor(points / 0.5).astype(int)
    keys = voxel_keys(points, 0.5)
    by_cell, by_key = (np.unique(x, axis=0, return_inverse=True)[1].ravel() for x in (cells, keys))
    assert np.array_equal(by_cell, by_key)


@pytest.mark.parametrize("far", [0.0, 1e4, 1e15])  # a box that is dense, empty, of too many voxels to be counted
def test_the_grid_is_the_mean_of_each_voxel_by_z_then_y_then_x(far: float) -> None:
    points = np.append(np.random.default_rng(0).uniform(-3, 3, (5000, 3)), [[far, 0.1, 0.1]], axis=0)
    cells, rank = np.unique(np.floor(points[:, ::-1] / 0.5), axis=0, return_inverse=True)
    means = [points[rank.ravel() == i].mean(0) for i in range(len(cells))]
    np.testing.assert_allclose(voxel_downsample(points, 0.5), means, atol=1e-12)


def test_a_voxel_far_away_meets_no_other() -> None:
    line = np.arange(-(2**20), 2**20, 1000)[:, None] * np.eye(3)[[0]] + 0.5
    assert len(np.unique(voxel_keys(line, 1.0))) == len(line)


@pytest.mark.parametrize("far", [0.0, 1e5])  # the second: a box of more voxels than a float counts
def test_the_occupied_voxels_are_those_of_their_keys(far: float) -> None:
    points = np.append(np.random.default_rng(0).uniform(-3, 3, (5000, 3)), [[far, -far, far]], axis=0)
    given = points.copy(order="F")
    expected = len(np.unique(np.floor((points - points.min(0)) / 0.05), axis=0))
    assert occupied_voxels(given, 0.05) == expected
    assert np.array_equal(given, points)


def test_grids_of_doubled_edges_are_those_of_the_points() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (20_000, 3))
    points[:5000, 0] = 0.3  # a plane on the border of voxels, where a mean may lie on either side
    grid = Voxels.of(points, 0.1)
    for edge in (0.1, 0.2, 0.4):
        assert grid.edge == edge
        np.testing.assert_allclose(grid.means, voxel_downsample(points, edge), atol=1e-12)
        grid = grid.doubled()
