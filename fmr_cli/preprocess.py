"""From a cloud to what the method sees: voxel grid, local origin, working scale, normals, and the exact inverse.

Everything follows from the data's own extent and spacing: multiplying all coordinates by a constant multiplies every
length here by it and changes nothing else.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

WORKING_VOXELS = 5000  # the voxel edge is chosen so that about so many are occupied
SAMPLE = 15_000  # points that the choice of the voxel edge looks at
NORMAL_NEIGHBOURS = 16
BORDER = 1e-3  # surface variation that a lean of 1 counts as
SPARSE = 4.0  # voxel edges: on a full surface 16 neighbours lie within 2.5


def voxel_downsample(points: np.ndarray, edge: float) -> np.ndarray:
    """The mean of the points in each occupied voxel: (N, 3) -> (M, 3), in a fixed order (single-threaded)."""
    import small_gicp

    return np.asarray(small_gicp.voxelgrid_sampling(points, edge, num_threads=1).points())[:, :3].copy()


def occupied_voxels(points: np.ndarray, edge: float) -> int:
    """How many voxels of the given edge hold a point."""
    return len(np.unique(cell_numbers(points, edge)))


def cell_numbers(points: np.ndarray, edge: float) -> np.ndarray:
    """The voxel that each point lies in, as one number: (N, 3) -> (N,) int64."""
    x, y, z = (np.floor((c - c.min()) / edge).astype(np.int64) for c in points.T)
    return (x * (y.max() + 1) + y) * (z.max() + 1) + z


def distinct(points: np.ndarray) -> np.ndarray:
    """The points without exact repetitions: (N, 3) -> (M, 3), M <= N.

    Sorted by their distance along one oblique line, which differs for all points that differ (but by a rare chance).
    """
    return points[np.unique(points @ [0.5377, 0.3183, 0.7809], return_index=True)[1]]


def sample(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` points without repetition, (N, 3) -> (min(N, count), 3)."""
    return points if len(points) <= count else points[rng.choice(len(points), count, replace=False)]


def working_scale(points: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """The voxel edge at which about ``WORKING_VOXELS`` are occupied, and the spacing of distinct points, own unit.

    Both by count, so that a few points far away do not matter. The spacing is the median distance to the nearest other
    point, rescaled from a sample as on a surface.
    """
    some = sample(points, SAMPLE, rng)
    nearest = cKDTree(some).query(sample(some, 2000, rng), 2)[0][:, 1]
    spacing = float(np.median(nearest)) * np.sqrt(len(some) / max(len(points), len(some)))
    low, high = spacing / 4, float(np.ptp(some, axis=0).max())
    for _ in range(10):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if occupied_voxels(some, middle) > WORKING_VOXELS else (low, middle)
    return high, spacing


def normals_and_variation(points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of the nearest 16 points: unit normals (M, 3), their sign undetermined; surface variation, reach, lean (M,) each.

    The surface variation is the smallest eigenvalue of the neighbourhood's covariance over their sum (Pauly 2002), 0 on
    a plane, 1/3 where it is round; the reach is the distance to the last of the 16; the lean, how far off their mean is
    as a share of it: most at a border.
    """
    distance, index = tree.query(points, min(NORMAL_NEIGHBOURS, len(points)))
    neighbours = points[index]
    means = neighbours.mean(1, keepdims=True)
    centred = neighbours - means
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    variation = np.maximum(values[:, 0], 0) / np.maximum(values.sum(1), 1e-300)
    lean = np.linalg.norm(means[:, 0] - points, axis=1) / np.maximum(distance[:, -1], 1e-300)
    return vectors[:, :, 0], variation, distance[:, -1], lean


class Surface:
    """A cloud on a voxel grid, with what its neighbourhoods say. points: (M, 3) own unit; edge: of the voxels."""

    def __init__(self, points: np.ndarray, edge: float) -> None:
        self.edge = edge
        self.points = voxel_downsample(points, edge)
        self.tree = cKDTree(self.points)

    @cached_property
    def _shape(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return normals_and_variation(self.points, self.tree)

    @property
    def normals(self) -> np.ndarray:
        """(M, 3) unit normals of undetermined sign."""
        return self._shape[0]

    @cached_property
    def unevenness(self) -> tuple[np.ndarray, np.ndarray]:
        """How far the nearest 3 lie off each point's tangent plane, own unit, and 1 - |cosine| of their normals: (M,).

        What curvature and noise make of two samples of one surface.
        """
        index = self.tree.query(self.points, 4)[1][:, 1:]
        off = np.einsum("nki,ni->nk", self.points[index] - self.points[:, None], self.normals)
        return np.abs(off).mean(1), 1 - np.abs(np.einsum("nki,ni->nk", self.normals[index], self.normals)).mean(1)

    def keypoints(self, count: int) -> np.ndarray:
        """Indices of the points of highest surface variation, at most one in a cell of two voxels, at most ``count``.

        Where neighbours are far, as in a LiDAR's outskirts, variation is chance: such points come last. What is flat
        has its keypoints on its outline.
        """
        _, variation, reach, lean = self._shape
        order = np.argsort(-np.where(reach < SPARSE * self.edge, variation + BORDER * lean, 0.0), kind="stable")
        first = np.unique(cell_numbers(self.points[order], 2 * self.edge), return_index=True)[1]
        return order[np.sort(first)[:count]]

    def patches(self, index: np.ndarray, radius: float, neighbours: int) -> dict[str, np.ndarray]:
        """The neighbourhoods of points ``index`` (K,): what ``feature_metric.local.describe_patches`` takes, float32.

        radius: in voxel edges. Offsets are in radii, nearest first; what a row lacks of ``neighbours`` is not valid.
        """
        centres = self.points[index]
        found = self.tree.query(centres, min(neighbours, len(self.points)), distance_upper_bound=radius * self.edge)[1]
        valid = found < len(self.points)
        found = np.where(valid, found, index[:, None])
        return {
            "offsets": ((self.points[found] - centres[:, None]) / (radius * self.edge)).astype(np.float32),
            "valid": valid.astype(np.float32),
            "normal": self.normals[index].astype(np.float32),
            "neighbour_normals": self.normals[found].astype(np.float32),
        }
