"""Nearest points: distances from very many points to a cloud, and many neighbours of a few."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cores import usable_cores

BITS = 16  # of the order in which points are looked up: numbers of two bytes are sorted in one pass


class NearestDistance:
    """Distances to the nearest of ``points`` (N, 3); all finite, float64, any frame."""

    def __init__(self, points: np.ndarray) -> None:
        import small_gicp

        self.origin = points.mean(0)
        # In this order what is near in space is near in memory: the tree is made and asked in two thirds of the time
        self.cloud = small_gicp.PointCloud(points[along_curve(points)] - self.origin)
        self.tree = small_gicp.KdTree(self.cloud, num_threads=usable_cores())

    def __call__(self, queries: np.ndarray) -> np.ndarray:
        """(M,) distances of queries (M, 3). Neighbours are looked up after each other, which is thrice as fast."""
        if len(queries) == 0:
            return np.zeros(0)
        order = along_curve(queries)
        local = queries[order] - self.origin
        # The search for k neighbours answers in arrays, that for one in lists
        squared = self.tree.batch_knn_search(local, 1, num_threads=usable_cores())[1]
        result = np.empty(len(queries))
        result[order] = np.sqrt(np.asarray(squared).reshape(-1))
        return result


def nearest_within(tree: cKDTree, centres: np.ndarray, radius: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The at most ``count`` points of a tree within ``radius`` of centres (K, 3): rows (K, count), nearest first.

    And which of them are there; 0 where they are not. All pairs within the radius, sorted as one array of numbers, take
    half of the time of the tree's own search for many neighbours, which keeps a heap for each centre.
    """
    pairs = cKDTree(centres, balanced_tree=False, compact_nodes=False).sparse_distance_matrix(
        tree, radius, output_type="ndarray"
    )
    # A number each: the centre, how far, the row. Of a thousand centres and a million points, in steps of 2^-32 radii.
    row_bits = tree.n.bit_length()
    bits = 62 - row_bits - len(centres).bit_length()
    key = (pairs["v"] * ((2**bits - 1) / radius)).astype(np.int64)
    key |= pairs["i"].astype(np.int64) << bits
    key <<= row_bits
    key |= pairs["j"]
    key.sort()
    counts = np.bincount(pairs["i"], minlength=len(centres))
    rank = np.arange(len(key)) - np.repeat(np.cumsum(counts) - counts, counts)
    there = np.arange(count) < counts[:, None]
    found = np.zeros(there.shape, np.int64)
    found[there] = key[rank < count] & ((1 << row_bits) - 1)
    return found, there


def along_curve(points: np.ndarray) -> np.ndarray:
    """The order of points (N, 3) along a Z-order curve through their box, whose longest side is halved BITS times."""
    low = points.min(0)
    size = np.maximum((points.max(0) - low).astype(float), 1e-300)
    sides, turns = size.copy(), []
    for _ in range(BITS):
        turns.append(int(sides.argmax()))
        sides[turns[-1]] /= 2
    depth = [turns.count(axis) for axis in range(3)]
    steps = [(points[:, k] - low[k]) * (((1 << depth[k]) - 0.5) / size[k]) for k in range(3)]
    cells = [column.astype(np.uint16) for column in steps]
    place = np.zeros(len(points), np.uint16)
    for axis in turns:
        depth[axis] -= 1
        place = (place << 1) | ((cells[axis] >> depth[axis]) & 1)
    return np.argsort(place, kind="stable")
