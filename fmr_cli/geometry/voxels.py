"""The voxel grid: which voxel a point lies in, the mean of each voxel, how many are occupied."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

# Voxels of the box for each point, up to which a table of them all is made: to look a point up there takes a third of
# the time of sorting it, or as long at twice as many.
DENSE = 8
BITS = 21  # of a voxel's index along an axis: three times 21 fit an int64


def voxel_downsample(points: np.ndarray, edge: float) -> np.ndarray:
    """The mean of the points in each occupied voxel: (N, 3) -> (M, 3), by z, then y, then x.

    A voxel's corner is at the origin. What small_gicp's grid gives to rounding, in a third of the time.
    """
    if not len(points):
        return points.copy()
    return voxel_means(points, voxel_ranks(points, edge))


def voxel_means(values: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """The mean of values (N, d) in each voxel, by the ``voxel_ranks`` (N,) of their points: (M, d)."""
    return np.stack([np.bincount(rank, c) for c in values.T], 1) / np.bincount(rank)[:, None]


@dataclass(frozen=True)
class Voxels:
    """Points summed up in the occupied voxels of a grid: from these, grids of 2, 4, ... times the edge take little.

    sums: (M, 3); counts: (M,); some: (M, 3) one point of each, which says where the voxel is, as its mean on a border
    may not. In the order of ``voxel_downsample``.
    """

    edge: float
    sums: np.ndarray
    counts: np.ndarray
    some: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, edge: float) -> Voxels:
        """Those of points (N, 3)."""
        return cls._merged(edge, voxel_ranks(points, edge), points, None, points)

    def doubled(self) -> Voxels:
        """Those of twice the edge: a border of theirs is one of these, to the bit."""
        return self._merged(2 * self.edge, voxel_ranks(self.some, 2 * self.edge), self.sums, self.counts, self.some)

    @property
    def means(self) -> np.ndarray:
        """What ``voxel_downsample`` gives, to rounding: (M, 3)."""
        return self.sums / self.counts[:, None]

    @classmethod
    def _merged(
        cls, edge: float, rank: np.ndarray, sums: np.ndarray, counts: np.ndarray | None, some: np.ndarray
    ) -> Voxels:
        """What falls into one voxel by its rank (N,), summed up."""
        counts = np.bincount(rank, counts)
        which = np.empty(len(counts), np.int64)
        which[rank] = np.arange(len(rank))
        return cls(edge, np.stack([np.bincount(rank, c) for c in sums.T], 1), counts, some[which])


def voxel_ranks(points: np.ndarray, edge: float) -> np.ndarray:
    """(N,) which voxel each of points (N, 3) lies in, the occupied ones counted from 0 by z, then y, then x."""
    cell, bits = np.empty(len(points)), len(points).bit_length()
    indices = (np.floor(np.multiply(c, 1 / edge, out=cell), out=cell) for c in points.T[::-1])
    key, cells = numbers_in_box(indices, len(points))
    if cells >= 1 << min(53, 63 - bits):  # a box of so many voxels is empty but for a few
        return np.unique(np.floor(points[:, ::-1] * (1 / edge)), axis=0, return_inverse=True)[1].reshape(-1)
    key = key.astype(np.int64)
    if cells <= DENSE * len(points):
        occupied = np.zeros(cells, bool)
        occupied[key] = True
        found = np.flatnonzero(occupied)
        rank_of = np.empty(cells, np.int64)
        rank_of[found] = np.arange(len(found))
        return rank_of[key]
    # Each point's own number in the last bits: to sort such numbers takes a fifth of the time of sorting by a key
    packed = key << bits | np.arange(len(points))
    packed.sort()
    voxel = packed >> bits
    rank = np.empty(len(points), np.int64)
    rank[packed & ((1 << bits) - 1)] = np.cumsum(np.diff(voxel, prepend=voxel[0]) != 0)
    return rank


def numbers_in_box(columns: Iterable[np.ndarray], count: int) -> tuple[np.ndarray, int]:
    """A number for each of ``count`` points' voxel in the points' box, and how many voxels that box has.

    columns: the voxels' whole-numbered indices (count,), axis by axis. Exact where the box has less than 2^53 voxels.
    """
    key, cells = np.zeros(count), 1
    for column in columns:
        low = column.min()
        size = int(column.max() - low) + 1
        cells *= size
        with np.errstate(over="ignore"):  # of a box that is too large in any case
            key *= float(size)
        key += column
        key -= low
    return key, cells


def occupied_voxels(points: np.ndarray, edge: float) -> int:
    """How many voxels of the given edge hold a point; the grid begins at the points' lower corner."""
    columns = np.array(points.T, float, order="C")  # a copy: thrice as fast as the points' rows
    columns -= columns.min(1, keepdims=True)
    columns /= edge
    key, cells = numbers_in_box(np.floor(columns, out=columns), len(points))
    if cells >= 1 << 53:
        key = voxel_keys(points - points.min(0), edge)
    key.sort()
    return 1 + int(np.count_nonzero(key[1:] != key[:-1]))


def voxel_keys(points: np.ndarray, edge: float) -> np.ndarray:
    """The voxel that each point lies in as one number: (N, 3) -> (N,) int64; a voxel's corner is at the origin.

    Equal for equal voxels in every cloud; in the order of (x, y, z). Indices wrap around: voxels whose indices along an
    axis differ by 2^21, about two million, have one key.
    """
    x, y, z = (
        (np.floor(c / edge).astype(np.int64) + (1 << (BITS - 1))) & ((1 << BITS) - 1) for c in np.asarray(points).T
    )
    return (x << 2 * BITS) | (y << BITS) | z
