"""The voxel grid: which voxel a point lies in, the mean of each voxel, how many are occupied."""

from __future__ import annotations

import numpy as np

BITS = 21  # of a voxel's index along an axis: three times 21 fit an int64


def voxel_downsample(points: np.ndarray, edge: float) -> np.ndarray:
    """The mean of the points in each occupied voxel: (N, 3) -> (M, 3), in a fixed order (single-threaded).

    In a unit near the edge: small_gicp takes none below a millionth. A power of two changes no bit of the result.
    """
    import small_gicp

    unit = 2.0 ** np.ceil(np.log2(edge))
    grid = small_gicp.voxelgrid_sampling(points / unit, edge / unit, num_threads=1)
    return unit * np.asarray(grid.points())[:, :3]


def occupied_voxels(points: np.ndarray, edge: float) -> int:
    """How many voxels of the given edge hold a point; the grid begins at the points' lower corner."""
    keys = np.sort(voxel_keys(points - points.min(0), edge))
    return 1 + int(np.count_nonzero(keys[1:] != keys[:-1]))


def voxel_keys(points: np.ndarray, edge: float) -> np.ndarray:
    """The voxel that each point lies in as one number: (N, 3) -> (N,) int64; a voxel's corner is at the origin.

    Equal for equal voxels in every cloud; in the order of (x, y, z). Indices wrap around: voxels whose indices along an
    axis differ by 2^21, about two million, have one key.
    """
    x, y, z = (
        (np.floor(c / edge).astype(np.int64) + (1 << (BITS - 1))) & ((1 << BITS) - 1) for c in np.asarray(points).T
    )
    return (x << 2 * BITS) | (y << BITS) | z
