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
SCALE_ROUNDS, SCALE_TOLERANCE = 20, 0.02
NORMAL_NEIGHBOURS = 16
CLOSE = 1e-2  # of the squared spread of eigenvalues: the closed form's rounding then shows in the eigenvector
BORDER = 1e-3  # surface variation that a lean of 1 counts as
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


def thinned(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most about ``count`` points, one from each stretch of the array, without a copy of it: (N, 3) -> (M, 3)."""
    if len(points) <= count:
        return points
    return points[((np.arange(count) + rng.random(count)) * (len(points) / count)).astype(int)]


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
    spacing = float(np.median(tree.query(sample(some, SPACING_SAMPLE, rng), 2)[0][:, 1]))
    edge, count = spacing, len(some)
    for _ in range(SCALE_ROUNDS):  # on a surface the count falls with the edge's square
        if count < (1 + SCALE_TOLERANCE) * WORKING_VOXELS:
            break
        edge *= np.sqrt(count / WORKING_VOXELS)
        count = occupied_voxels(some, edge)
    return edge, spacing * np.sqrt(len(some) / max(len(points), len(some)))


def neighbours(points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
    """The nearest 16 of each point, itself first: distances and rows, (M, 16) each, or fewer where there are fewer."""
    return tree.query(points, min(NORMAL_NEIGHBOURS, len(points)))


def normals_and_variation(
    points: np.ndarray, distance: np.ndarray, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each point's ``neighbours``: unit normals (M, 3), their sign undetermined; variation, reach, lean (M,) each.

    The surface variation is the smallest eigenvalue of the neighbourhood's covariance over their sum (Pauly 2002), 0 on
    a plane, 1/3 where it is round; the reach is the distance to the last of them; the lean, how far off their mean is
    as a share of it: most at a border.
    """
    x, y, z = (c[index] - c[:, None] for c in np.ascontiguousarray(points.T))
    means = [c.mean(1, keepdims=True) for c in (x, y, z)]
    for c, mean in zip((x, y, z), means, strict=True):
        c -= mean
    products = [np.einsum("ij,ij->i", a, b) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))]
    normals, least = smallest_eigenvector(*products)
    reach = np.maximum(distance[:, -1], 1e-300)
    lean = np.linalg.norm(np.hstack(means), axis=1) / reach
    return normals, least / np.maximum(sum(products[:3]), 1e-300), reach, lean


def smallest_eigenvector(
    xx: np.ndarray, yy: np.ndarray, zz: np.ndarray, xy: np.ndarray, xz: np.ndarray, yz: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of symmetric 3x3 matrices by their entries (M,): the unit eigenvector (M, 3) of the smallest eigenvalue (M,).

    In closed form (Smith 1961), several times faster than LAPACK on matrices this small, which still solves the few
    where two eigenvalues are too close for it.
    """
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    p = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(det / np.maximum(2 * p**3, 1e-300), -1, 1)) / 3
    least = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    # The eigenvector is orthogonal to the rows of the matrix less its eigenvalue: the longest of their cross products.
    a, b, c = xx - least, yy - least, zz - least
    crosses = np.array([
        [xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy],
        [xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz],
        [b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz],
    ])  # fmt: skip
    length2 = (crosses * crosses).sum(1)
    best = length2.argmax(0)
    rows = np.arange(len(best))
    normals = crosses[best, :, rows]
    length = np.sqrt(length2[best, rows])
    normals /= np.maximum(length, 1e-300)[:, None]
    close = np.flatnonzero(length < CLOSE * p * p)
    if len(close):
        C = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[..., close].transpose(2, 0, 1)
        values, vectors = np.linalg.eigh(C)
        normals[close], least[close] = vectors[..., 0], values[:, 0]
    return normals, np.maximum(least, 0)


class Surface:
    """A cloud on a voxel grid, with what its neighbourhoods say. points: (M, 3) own unit; edge: of the voxels."""

    def __init__(self, points: np.ndarray, edge: float) -> None:
        self.edge = edge
        self.points = voxel_downsample(points, edge)
        self.tree = cKDTree(self.points)

    @cached_property
    def _near(self) -> tuple[np.ndarray, np.ndarray]:
        return neighbours(self.points, self.tree)

    @cached_property
    def _shape(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return normals_and_variation(self.points, *self._near)

    @property
    def normals(self) -> np.ndarray:
        """(M, 3) unit normals of undetermined sign."""
        return self._shape[0]

    @cached_property
    def unevenness(self) -> tuple[np.ndarray, np.ndarray]:
        """How far the nearest 3 lie off each point's tangent plane, own unit, and 1 - |cosine| of their normals: (M,).

        What curvature and noise make of two samples of one surface.
        """
        p, n, off, cosine = self.points, self.normals, [], []
        for there in self._near[1].T[1:4]:
            off.append(np.abs(np.einsum("ni,ni->n", p[there] - p, n)))
            cosine.append(np.abs(np.einsum("ni,ni->n", n[there], n)))
        return np.mean(off, axis=0), 1 - np.mean(cosine, axis=0)

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
        middle = self.points.mean(0)  # about it, float32 is exact enough
        offsets = ((self.points - middle) / radius).astype(np.float32)[found]
        offsets -= ((centres - middle) / radius).astype(np.float32)[:, None]
        offsets *= valid[..., None]
        return offsets, valid, found
