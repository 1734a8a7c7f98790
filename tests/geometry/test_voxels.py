"""Voxel keys: one number a voxel, the same in every cloud."""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.voxels import voxel_keys


def test_equal_keys_are_equal_voxels_in_the_order_of_their_indices() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (5000, 3))
    cells = np.floor(points / 0.5).astype(int)
    keys = voxel_keys(points, 0.5)
    by_cell, by_key = (np.unique(x, axis=0, return_inverse=True)[1].ravel() for x in (cells, keys))
    assert np.array_equal(by_cell, by_key)


def test_a_voxel_far_away_meets_no_other() -> None:
    line = np.arange(-(2**20), 2**20, 1000)[:, None] * np.eye(3)[[0]] + 0.5
    assert len(np.unique(voxel_keys(line, 1.0))) == len(line)
