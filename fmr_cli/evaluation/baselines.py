"""What others would use in this tool's place, each as its own documentation tells it: source and target in, a pose out.

A baseline takes source (N, 3) and target (M, 3), float64, and gives T_target_source (4, 4). A library that is not
installed is said by ``missing``, before it runs. Where a baseline works on a grid, its voxel edge is given, in the
clouds' unit; its other lengths are multiples of that edge.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.errors import FmrError
from fmr_cli.evaluation.open3d_import import open3d
from fmr_cli.registration.prepared import SPACINGS

Baseline = Callable[[np.ndarray, np.ndarray], np.ndarray]

# Open3D's tutorial on global registration: radii and distances in voxel edges, neighbours at most, and RANSAC's checks.
NORMAL_RADIUS, NORMAL_NEIGHBOURS = 2.0, 30
FEATURE_RADIUS, FEATURE_NEIGHBOURS = 5.0, 100
INLIER_DISTANCE = 1.5
EDGE_SIMILARITY = 0.9  # of corresponding edges of a triple, shorter over longer
RANSAC_TRIPLES, RANSAC_CONFIDENCE = 100_000, 0.999
GICP_REACH = 4.0  # voxel edges to the farthest correspondence, the one its users set: 0.2 m at 0.05 m
LM_EVALUATIONS = 100  # of the residuals: scipy's LM has converged long before on what it can solve


def fpfh_ransac(source: np.ndarray, target: np.ndarray, voxel: float) -> np.ndarray:
    """FPFH features and RANSAC, by Open3D. Raises Open3DError."""
    registration = open3d().pipelines.registration
    (s, fs), (t, ft) = _fpfh(source, voxel), _fpfh(target, voxel)
    checks = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(EDGE_SIMILARITY),
        registration.CorrespondenceCheckerBasedOnDistance(INLIER_DISTANCE * voxel),
    ]
    found = registration.registration_ransac_based_on_feature_matching(
        s, t, fs, ft, True, INLIER_DISTANCE * voxel, registration.TransformationEstimationPointToPoint(False), 3,
        checks, registration.RANSACConvergenceCriteria(RANSAC_TRIPLES, RANSAC_CONFIDENCE),
    )  # fmt: skip
    return np.array(found.transformation)


def _fpfh(points: np.ndarray, voxel: float) -> tuple[Any, Any]:
    """Open3D's cloud on the grid, and its features."""
    o3d = open3d()
    near = o3d.geometry.KDTreeSearchParamHybrid
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    cloud.estimate_normals(near(NORMAL_RADIUS * voxel, NORMAL_NEIGHBOURS))
    features = o3d.pipelines.registration.compute_fpfh_feature(cloud, near(FEATURE_RADIUS * voxel, FEATURE_NEIGHBOURS))
    return cloud, features


def kiss_matcher(source: np.ndarray, target: np.ndarray, voxel: float) -> np.ndarray:
    """KISS-Matcher as it comes."""
    from kiss_matcher import KISSMatcher, KISSMatcherConfig

    found = KISSMatcher(KISSMatcherConfig(voxel)).estimate(source.astype(np.float32), target.astype(np.float32))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
    return T


def gicp(
    source: np.ndarray,
    target: np.ndarray,
    voxel: float,
    start: np.ndarray | None = None,
    reach: float | None = None,
    threads: int = 1,
) -> np.ndarray:
    """small_gicp's GICP from ``start``, T_target_source, else the identity; reach: GICP_REACH edges if not given."""
    import small_gicp

    return small_gicp.align(
        target, source, np.eye(4) if start is None else start, registration_type="GICP", downsampling_resolution=voxel,
        max_correspondence_distance=reach or GICP_REACH * voxel, num_threads=threads,
    ).T_target_source  # fmt: skip


def lm_icp(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Levenberg-Marquardt on the distances of all source points to the target (Fitzgibbon 2003), by scipy."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    tree = cKDTree(target)

    def moved(xi: np.ndarray) -> np.ndarray:
        return source @ Rotation.from_rotvec(xi[:3]).as_matrix().T + xi[3:]

    xi = np.zeros(6)
    if len(source) >= 6:  # else not determined
        xi = least_squares(lambda x: tree.query(moved(x))[0], xi, method="lm", max_nfev=LM_EVALUATIONS).x
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(xi[:3]).as_matrix(), xi[3:]
    return T


# Those that need no start, and so can stand where this tool's own hypotheses do: (function, its package).
GLOBAL = {"KISS-Matcher": (kiss_matcher, "kiss_matcher"), "FPFH + RANSAC": (fpfh_ransac, "open3d")}


def missing(package: str) -> str | None:
    """Why a baseline that needs a package cannot run, on one line; None where it can."""
    if package == "open3d":
        try:
            open3d()
        except FmrError as error:
            return str(error)
        return None
    return None if importlib.util.find_spec(package) else f"{package} is not installed"


Voxel = Callable[[np.ndarray, np.ndarray], float]  # of source and target: the edge of the grid that suits them


def filled(voxel: float, source: np.ndarray, target: np.ndarray) -> float:
    """The edge ``voxel``, or the finest one that the points of both clouds fill, where that is coarser.

    On a finer grid there are no neighbours to describe a point by, and KISS-Matcher ends the process.
    """
    spacing = max(float(np.median(cKDTree(cloud).query(cloud, 2)[0][:, 1])) for cloud in (source, target))
    return max(voxel, SPACINGS * spacing)


def global_baselines(voxel: float) -> tuple[dict[str, Baseline], list[str]]:
    """The baselines of GLOBAL that can run, on that voxel edge, and a line for each that cannot."""
    return global_baselines_at(lambda source, target: voxel)


def global_baselines_at(voxel: Voxel) -> tuple[dict[str, Baseline], list[str]]:
    """The same, on a voxel edge that follows from the pair."""
    reasons = {name: missing(package) for name, (_, package) in GLOBAL.items()}

    def at(run: Callable[..., np.ndarray], source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return run(source, target, voxel=voxel(source, target))

    there: dict[str, Baseline] = {n: partial(at, f) for n, (f, _) in GLOBAL.items() if reasons[n] is None}
    return there, [f"no {name}: {reason}" for name, reason in reasons.items() if reason is not None]


def then_gicp(start: Baseline, voxel: Voxel, edges: float = GICP_REACH, threads: int = 1) -> Baseline:
    """A baseline, and GICP from where it ends, as one would use it. edges: to the farthest correspondence."""

    def run(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        edge = voxel(source, target)
        return gicp(source, target, edge, start=start(source, target), reach=edges * edge, threads=threads)

    return run
