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
SPACING_SAMPLE = 1_000  # of them, whose nearest neighbour is looked up
SCALE_ROUNDS = 5
NORMAL_NEIGHBOURS = 16
SPARSE = 4.0  # voxel edges: on a full surface 16 neighbours lie within 2.5


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
    tree = cKDTree(some, balanced_tree=False, compact_nodes=False)
    nearest = tree.query(sample(some, SPACING_SAMPLE, rng), 2)[0][:, 1]
    spacing = float(np.median(nearest)) * np.sqrt(len(some) / max(len(points), len(some)))
    edge, least = spacing * np.sqrt(len(some) / WORKING_VOXELS), spacing / 4
    for _ in range(SCALE_ROUNDS):  # on a surface the count falls with the edge's square
        edge = max(edge * np.sqrt(occupied_voxels(some, edge) / WORKING_VOXELS), least)
    return edge, spacing


def normals_and_variation(points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the nearest 16 points: unit normals (M, 3), their sign undetermined, surface variation (M,), and reach (M,).

    The surface variation is the smallest eigenvalue of the neighbourhood's covariance over their sum (Pauly 2002), 0 on
    a plane, 1/3 where it is round; the reach is the distance to the last of the 16.
    """
    distance, index = tree.query(points, min(NORMAL_NEIGHBOURS, len(points)))
    neighbours = points[index]
    centred = neighbours - neighbours.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    return vectors[:, :, 0], values[:, 0] / np.maximum(values.sum(1), 1e-300), distance[:, -1]


class Surface:
    """A cloud on a voxel grid, with what its neighbourhoods say. points: (M, 3) own unit; edge: of the voxels."""

    def __init__(self, points: np.ndarray, edge: float) -> None:
        self.edge = edge
        self.points = voxel_downsample(points, edge)
        self.tree = cKDTree(self.points)

    @cached_property
    def _shape(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return normals_and_variation(self.points, self.tree)

    @property
    def normals(self) -> np.ndarray:
        """(M, 3) unit normals of undetermined sign."""
        return self._shape[0]

    def keypoints(self, count: int) -> np.ndarray:
        """Indices of the points of highest surface variation, at most one in a cell of two voxels, at most ``count``.

        Where neighbours are far, as in a LiDAR's outskirts, variation is chance: such points come last.
        """
        _, variation, reach = self._shape
        order = np.argsort(-np.where(reach < SPARSE * self.edge, variation, 0.0), kind="stable")
        first = np.unique(cell_numbers(self.points[order], 2 * self.edge), return_index=True)[1]
        return order[np.sort(first)[:count]]

    def patches(self, index: np.ndarray, radius: float, neighbours: int) -> dict[str, np.ndarray]:
        """The neighbourhoods of points ``index`` (K,): what ``feature_metric.local.describe_patches`` takes, float32.

        radius: in voxel edges. Offsets are in radii, nearest first; what a row lacks of ``neighbours`` is not valid.
        """
        offsets, valid, found = self.around(self.points[index], radius * self.edge, neighbours)
        normals = self.normals.astype(np.float32)
        return {
            "offsets": offsets, "valid": valid, "normal": normals[index], "neighbours": found, "normals": normals,
        }  # fmt: skip

    def around(self, centres: np.ndarray, radius: float, neighbours: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The at most ``neighbours`` nearest points within ``radius`` of centres (K, 3), own unit, nearest first.

        Their offsets from the centre in radii (K, n, 3) and which of them are there (K, n), float32; their rows (K, n),
        0 where they are not.
        """
        found = self.tree.query(centres, min(neighbours, len(self.points)), distance_upper_bound=radius)[1]
        valid = (found < len(self.points)).astype(np.float32)
        found[found == len(self.points)] = 0
        offsets = ((self.points[found] - centres[:, None]) / radius).astype(np.float32)
        offsets *= valid[..., None]
        return offsets, valid, found
