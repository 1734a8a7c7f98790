"""What is compared: this method with any weights, and the paper's baselines on the very same pairs.

A method takes normalised pairs and gives (B, 4, 4) float64 estimates of T_target_source, one a pair.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from importlib.resources import as_file, files

import numpy as np
import torch
from torch import Tensor

from fmr_cli.evaluation.heldout import register
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.registration.models import Device, encoder
from fmr_cli.synthetic.batches import Pairs

Method = Callable[[Pairs], Tensor]

VOXEL = 0.02  # of the unit box, for the baselines that work on a grid
REACH = 0.2  # farthest correspondence of GICP, as wide as a pose it can still pull in
LM_EVALUATIONS = 100


def ours(weights: Encoder, iterations: int, robust: bool) -> Method:
    """The IC solver from the identity: one start, no search, no geometric polish."""
    return lambda pairs: register(weights, pairs, iterations, robust)


def one_by_one(solve: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Method:
    """A method from a function of one pair, (N, 3) source and (M, 3) target float64 -> 4x4."""

    def run(pairs: Pairs) -> Tensor:
        clouds = zip(pairs.source.double().cpu().numpy(), pairs.target.double().cpu().numpy(), strict=True)
        return torch.from_numpy(np.stack([solve(source, target) for source, target in clouds])).to(pairs.source.device)

    return run


def lm_icp(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Levenberg-Marquardt on the distances of all source points to the target (Fitzgibbon 2003), by scipy."""
    from scipy.optimize import least_squares
    from scipy.spatial import cKDTree
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


def gicp(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """small_gicp from the identity."""
    import small_gicp

    return small_gicp.align(
        target, source, downsampling_resolution=VOXEL, max_correspondence_distance=REACH, num_threads=1
    ).T_target_source


def fpfh_ransac(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """FPFH features and RANSAC, by Open3D: in the place of the paper's 3DSmoothNet."""
    import open3d as o3d

    reg = o3d.pipelines.registration
    described = []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(VOXEL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(5 * VOXEL, 30))
        described.append(
            (cloud, reg.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(10 * VOXEL, 100)))
        )
    (s, fs), (t, ft) = described
    return np.asarray(
        reg.registration_ransac_based_on_feature_matching(
            s, t, fs, ft, True, 2 * VOXEL, reg.TransformationEstimationPointToPoint(False), 3,
            [reg.CorrespondenceCheckerBasedOnDistance(2 * VOXEL)], reg.RANSACConvergenceCriteria(50_000, 0.999),
        ).transformation
    )  # fmt: skip


def kiss_matcher(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """KISS-Matcher alone, without a polish after it."""
    import kiss_matcher as km

    found = km.KISSMatcher(km.KISSMatcherConfig(VOXEL)).estimate(source, target)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(found.rotation), np.asarray(found.translation).ravel()
    return T


def pointnetlk(device: Device, iterations: int) -> Method:
    """The same IC with plain steps and an encoder trained on the pose loss alone, by models/pointnetlk.toml."""
    with as_file(files("fmr_cli.models") / "pointnetlk.safetensors") as path:
        return ours(encoder(path, device), iterations, robust=False)


def baselines(device: Device, iterations: int) -> tuple[dict[str, Method], list[str]]:
    """PointNetLK, the baselines whose libraries are installed, and a line for each that is not."""
    known = {
        "LM-ICP": (lm_icp, "scipy"),
        "small_gicp": (gicp, "small_gicp"),
        "FPFH + RANSAC": (fpfh_ransac, "open3d"),
        "KISS-Matcher": (kiss_matcher, "kiss_matcher"),
    }
    there = {"PointNetLK": pointnetlk(device, iterations)}
    there |= {name: one_by_one(f) for name, (f, package) in known.items() if importlib.util.find_spec(package)}
    return there, [f"no {name}: {p} is not installed" for name, (_, p) in known.items() if name not in there]
