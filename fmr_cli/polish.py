"""The last geometric step: from a pose that is right to one that is exact, and what the scans say about its certainty.

Rigid motions are polished by small_gicp. Constrained motions and scale, which it does not offer, take a point-to-plane
iteration of the same form; its normal equations at the end also give the information matrix of every result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.preprocess import Surface, neighbours, normals_and_variation

ITERATIONS = 30
COVARIANCE_NEIGHBOURS = 10
WEAK = 2e-3  # of the strongest direction's information: what the noise of the normals alone pretends to


class GicpCloud:
    """Points with their covariances as small_gicp takes them, in voxel edges, so that its thresholds have no unit.

    threads: to work on the points, each by itself, so that nothing depends on their number.
    """

    def __init__(self, points: np.ndarray, edge: float, threads: int = 1) -> None:
        import small_gicp

        self.cloud = small_gicp.PointCloud(points / edge)
        self.tree = small_gicp.KdTree(self.cloud)
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


@dataclass
class Normal:
    """The normal equations of point-to-plane at a pose: A = Σ w JᵀJ and b = Σ w Jᵀr over the twist (omega, v[, log s]).

    variance: of the weighted residuals, own unit squared. count: correspondences.
    """

    A: np.ndarray
    b: np.ndarray
    variance: float
    count: int


def point_to_plane(
    source: np.ndarray,
    target: np.ndarray,
    normals: np.ndarray,
    tree: cKDTree,
    T: np.ndarray,
    reach: float,
    pivot: np.ndarray,
) -> Normal:
    """Linearise n·(T x - y) over nearest neighbours within reach; the twist turns (and scales) about ``pivot`` (3,)."""
    moved = source @ T[:3, :3].T + T[:3, 3]
    distance, match = tree.query(moved, distance_upper_bound=reach)
    here = np.isfinite(distance)
    x, y, n = moved[here], target[match[here]], normals[match[here]]
    r = np.einsum("ni,ni->n", n, x - y)
    J = np.hstack([np.cross(x - pivot, n), n, np.einsum("ni,ni->n", n, x - pivot)[:, None]])
    s2 = (3 * np.median(np.abs(r))) ** 2 + 1e-24 * reach**2 if len(r) else 1.0
    w = (s2 / (s2 + r * r)) ** 2
    A = J.T @ (w[:, None] * J)
    return Normal(A, J.T @ (w * r), float((w * r * r).sum() / max(w.sum(), 1e-12)), len(r))


def constrained(
    source: np.ndarray, target: np.ndarray, T: np.ndarray, edge: float, basis: np.ndarray, scale: bool
) -> np.ndarray:
    """Point-to-plane from T (4x4) within the span of basis (6, d), and with one scale factor where asked."""
    tree = cKDTree(target)
    normals = normals_and_variation(target, *neighbours(target, tree))[0]
    B = np.zeros((7, basis.shape[1] + scale))
    B[:6, : basis.shape[1]] = basis
    if scale:
        B[6, -1] = 1
    pivot = target.mean(0)
    g = T.copy()
    for iteration in range(ITERATIONS):
        reach = edge * (2.0 if iteration < ITERATIONS // 2 else 1.0)
        normal = point_to_plane(source, target, normals, tree, g, reach, pivot)
        if normal.count < 6:
            return T
        step = -B @ np.linalg.lstsq(B.T @ normal.A @ B, B.T @ normal.b, rcond=1e-12)[0]
        g = _about(pivot, step) @ g
        if np.abs(step[:3]).max() < 1e-9 and np.abs(step[3:6]).max() < 1e-9 * edge:
            break
    return g


def _about(pivot: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The motion of a step (omega, v, log s) about pivot as 4x4: x -> s R (x - pivot) + pivot + v."""
    M = np.eye(4)
    M[:3, :3] = np.exp(step[6]) * Rotation.from_rotvec(step[:3]).as_matrix()
    M[:3, 3] = pivot + step[3:6] - M[:3, :3] @ pivot
    return M


def information(source: Surface, target: Surface, T: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The 6x6 information matrix of the pose, order (rotation, translation): rad⁻² and unit⁻².

    Of a twist in the target's frame about ``origin`` (3,), from point-to-plane at T; the residuals' own variance stands
    for the noise, and a voxel's points count as one observation.
    """
    normal = point_to_plane(
        source.points, target.points, target.normals, target.tree, T, 1.5 * target.edge, origin
    )  # fmt: skip
    floor = (1e-6 * target.edge) ** 2
    return normal.A[:6, :6] / max(normal.variance, floor)


def undetermined(info: np.ndarray, length: float) -> list[str]:
    """The directions that the scans hardly determine, in words: those WEAK against the strongest.

    info: (6, 6); length: turns radians into the unit, so that both kinds of motion compare.
    """
    S = np.diag([1 / length] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(S @ info @ S)
    said = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > WEAK * max(values[-1], 1e-300):
            continue
        omega, v = vector[:3], vector[3:]
        axis = omega if np.linalg.norm(omega) > np.linalg.norm(v) else v
        axis = axis / np.linalg.norm(axis)
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        where = "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))  # no -0.00
        said.append(f"rotation about {where}" if np.linalg.norm(omega) > np.linalg.norm(v) else f"shift along {where}")
    return said
