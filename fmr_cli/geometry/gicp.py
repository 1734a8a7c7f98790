"""Generalised ICP by small_gicp, the last geometric step of a rigid registration."""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.nearest import along_curve

COVARIANCE_NEIGHBOURS = 10  # points: small_gicp's own default


class GicpCloud:
    """Points with their covariances as small_gicp takes them, in voxel edges, so that its thresholds have no unit.

    threads: to work on the points, each by itself, so that nothing depends on their number.
    """

    def __init__(self, points: np.ndarray, edge: float, threads: int = 1) -> None:
        import small_gicp

        # In this order what is near in space is near in memory: of 100,000 points it takes a third of the time off
        self.cloud = small_gicp.PointCloud(points[along_curve(points)] / edge)
        self.tree = small_gicp.KdTree(self.cloud, threads)
        small_gicp.estimate_covariances(self.cloud, self.tree, COVARIANCE_NEIGHBOURS, threads)


def gicp(source: GicpCloud, target: GicpCloud, T: np.ndarray, edge: float) -> np.ndarray:
    """Generalised ICP (Segal et al. 2009) from T (4x4), within two voxel edges, then one; repeats bit for bit."""
    import small_gicp

    g = T.copy()
    g[:3, 3] /= edge
    for reach, iterations, epsilon in ((2.0, 10, 1e-2), (1.0, 10, 1e-4)):
        g = small_gicp.align(
            target.cloud, source.cloud, target.tree, g, registration_type="GICP", max_correspondence_distance=reach,
            max_iterations=iterations, rotation_epsilon=epsilon / 10, translation_epsilon=epsilon,
        ).T_target_source  # fmt: skip
    g = g.copy()
    g[:3, 3] *= edge
    return g
