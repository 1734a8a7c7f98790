"""The voxel grid: which cell a point lies in, the mean of each cell, the edge at which a wanted number is occupied."""

from __future__ import annotations

import numpy as np


def voxel_downsample(points: np.ndarray, edge: float) -> np.ndarray:
    """The mean of the points in each occupied voxel: (N, 3) -> (M, 3), in a fixed order (single-threaded)."""
    import small_gicp

    return np.asarray(small_gicp.voxelgrid_sampling(points, edge, num_threads=1).points())[:, :3].copy()


def occupied_voxels(points: np.ndarray, edge: float) -> int:
    """How many voxels of the given edge hold a point."""
    cells = np.sort(cell_numbers(points, edge))
    return 1 + int(np.count_nonzero(cells[1:] != cells[:-1]))


def cell_numbers(points: np.ndarray, edge: float) -> np.ndarray:
    """The voxel that each point lies in, as one number: (N, 3) -> (N,) int64."""
    x, y, z = (np.floor((c - c.min()) / edge).astype(np.int64) for c in points.T)
    return (x * (y.max() + 1) + y) * (z.max() + 1) + z
