"""Generalised ICP by small_gicp, the last geometric step of a rigid registration."""

from __future__ import annotations

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.nearest import along_curve
from fmr_cli.geometry.observability import Observations

COVARIANCE_NEIGHBOURS = 10  # points: small_gicp's own default
REACH = 1.0  # voxel edges: partners further apart are none, in the end
THIN = 1e-3  # of a point's covariance along its normal, that along the surface being 1: small_gicp's own
# Points, fewer of which one thread prepares in twenty milliseconds; a second one that waits for more spins for ten.
MANY = 20_000


class GicpCloud:
    """Points with their covariances as small_gicp takes them, in voxel edges, so that its thresholds have no unit.

    threads: to work on the points, each by itself, so that nothing depends on their number.
    """

    def __init__(self, points: np.ndarray, edge: float, threads: int = 1) -> None:
        import small_gicp

        threads = threads if len(points) > MANY else 1
        # In this order what is near in space is near in memory: of 100,000 points it takes a third of the time off
        self.cloud = small_gicp.PointCloud(points[along_curve(points)] / edge)
        self.tree = small_gicp.KdTree(self.cloud, threads)
        small_gicp.estimate_normals_covariances(self.cloud, self.tree, COVARIANCE_NEIGHBOURS, threads)

    @property
    def points(self) -> np.ndarray:
        """(N, 3) in voxel edges."""
        return self.cloud.points()[:, :3]

    @property
    def normals(self) -> np.ndarray:
        """(N, 3), of undetermined sign: a point's covariance is 1 - (1 - THIN) n nᵀ."""
        return self.cloud.normals()[:, :3]


def gicp(source: GicpCloud, target: GicpCloud, T: np.ndarray, edge: float) -> np.ndarray:
    """Generalised ICP (Segal et al. 2009) from T (4x4), within two voxel edges, then one; repeats bit for bit."""
    import small_gicp

    g = T.copy()
    g[:3, 3] /= edge
    for reach, iterations, epsilon in ((2 * REACH, 10, 1e-2), (REACH, 10, 1e-4)):
        g = small_gicp.align(
            target.cloud, source.cloud, target.tree, g, registration_type="GICP", max_correspondence_distance=reach,
            max_iterations=iterations, rotation_epsilon=epsilon / 10, translation_epsilon=epsilon,
        ).T_target_source  # fmt: skip
    g = g.copy()
    g[:3, 3] *= edge
    return g


def observed(source: GicpCloud, target: GicpCloud, T: np.ndarray, edge: float) -> Observations:
    """What ``gicp`` goes by at T (4x4), as planes between those of partners.

    Its weight of a residual is the inverse of both covariances' sum, (2 - (1 - THIN) (1 + |cosine|))⁻¹ along the mean
    of the normals. Across that it is a thousandth of what it is along it, where the normals agree: it is left out.
    """
    g = T.copy()
    g[:3, 3] /= edge
    x = transform_points(g, source.points)
    found, squared = (np.array(each) for each in target.tree.batch_nearest_neighbor_search(x))
    here = np.flatnonzero((found >= 0) & (squared < REACH**2))
    j = found[here]
    a, b = source.normals[here] @ T[:3, :3].T, target.normals[j]
    cosine = np.einsum("ni,ni->n", a, b)
    n = a + np.where(cosine < 0, -1.0, 1.0)[:, None] * b
    n /= np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]
    weight = 2 * THIN / (2 - (1 - THIN) * (1 + np.abs(cosine)))
    return Observations(x[here] * edge, target.points[j] * edge, n, weight, weight)
