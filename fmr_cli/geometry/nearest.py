"""Distances from very many points to a cloud."""

from __future__ import annotations

import numpy as np

from fmr_cli.cores import usable_cores

CELLS = 1 << 10  # along each side of the box, of the order in which points are looked up
# Moves ten bits of a number apart, so that two others fit in between each two
SPREAD = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))


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


def along_curve(points: np.ndarray) -> np.ndarray:
    """The order of points (N, 3) along a Z-order curve through their bounding box."""
    low, high = points.min(0), points.max(0)
    cells = ((points - low) / np.maximum(high - low, 1e-300) * (CELLS - 1)).astype(np.uint32)
    for shift, mask in SPREAD:
        cells = (cells | cells << shift) & mask
    return np.argsort(cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2)
