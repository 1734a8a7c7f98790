"""From a cloud to what the method sees: voxel grid, local origin, working scale, normals, and the exact inverse.

Everything follows from the data's own extent and spacing: multiplying all coordinates by a constant multiplies every
length here by it and changes nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

WORKING_VOXELS = 5000  # the voxel edge is chosen so that about so many are occupied
SAMPLE = 40_000  # points that the choice of the voxel edge looks at
HALF_EXTENT = 0.5  # of a normalised cloud, as the encoder was trained
NORMAL_NEIGHBOURS = 16


def voxel_downsample(points: np.ndarray, edge: float) -> np.ndarray:
    """The mean of the points in each occupied voxel: (N, 3) -> (M, 3), in a fixed order (single-threaded)."""
    import small_gicp

    return np.asarray(small_gicp.voxelgrid_sampling(points, edge, num_threads=1).points())[:, :3].copy()


def occupied_voxels(points: np.ndarray, edge: float) -> int:
    """How many voxels of the given edge hold a point."""
    cells = np.floor((points - points.min(0)) / edge).astype(np.int64)
    size = cells.max(0) + 1
    return len(np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]))


def sample(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` points without repetition, (N, 3) -> (min(N, count), 3)."""
    return points if len(points) <= count else points[rng.choice(len(points), count, replace=False)]


def working_scale(points: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """The voxel edge at which about ``WORKING_VOXELS`` are occupied, and the spacing of the points, own unit.

    Both by count, so that a few points far away do not matter. The spacing is the median distance to the nearest other
    point, rescaled from a sample as on a surface.
    """
    some = sample(points, SAMPLE, rng)
    some = np.unique(some, axis=0)
    nearest = cKDTree(some).query(sample(some, 2000, rng), 2)[0][:, 1]
    spacing = float(np.median(nearest)) * np.sqrt(len(some) / max(len(points), len(some)))
    low, high = spacing / 4, float(np.ptp(some, axis=0).max())
    for _ in range(14):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if occupied_voxels(some, middle) > WORKING_VOXELS else (low, middle)
    return high, spacing


def normals_and_variation(points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (M, 3), their sign undetermined, and the surface variation (M,), from the nearest 16 points.

    The surface variation is the smallest eigenvalue of the neighbourhood's covariance over their sum (Pauly 2002).
    """
    k = min(NORMAL_NEIGHBOURS, len(points))
    neighbours = points[tree.query(points, k)[1]]
    centred = neighbours - neighbours.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    return vectors[:, :, 0], values[:, 0] / np.maximum(values.sum(1), 1e-300)


@dataclass(frozen=True)
class Normalisation:
    """x -> (x - centre) / scale, and its exact inverse on poses. centre: (3,) own unit; scale: own unit per unit box."""

    centre: np.ndarray
    scale: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        return (points - self.centre) / self.scale


class Surface:
    """A cloud on a voxel grid, with what its neighbourhoods say. points: (M, 3) own unit; edge: of the voxels."""

    def __init__(self, points: np.ndarray, edge: float) -> None:
        self.edge = edge
        self.points = voxel_downsample(points, edge)
        self.tree = cKDTree(self.points)
        self.normals, self.variation = normals_and_variation(self.points, self.tree)

    def keypoints(self, count: int) -> np.ndarray:
        """Indices of the points of highest surface variation, at most one in a cell of two voxels, at most ``count``."""
        order = np.argsort(-self.variation, kind="stable")
        cells = np.floor((self.points[order] - self.points.min(0)) / (2 * self.edge)).astype(np.int64)
        size = cells.max(0) + 1
        first = np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_index=True)[1]
        return order[np.sort(first)[:count]]

    def patches(self, index: np.ndarray, radius: float, neighbours: int) -> dict[str, np.ndarray]:
        """The neighbourhoods of points ``index`` (K,): what ``feature_metric.local.describe_patches`` takes, float32.

        radius: in voxel edges. Offsets are in radii, nearest first; rows shorter than ``neighbours`` are not valid there.
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
