"""The last geometric step: from a pose that is right to one that is exact, and what the scans say about its certainty.

Rigid motions are polished by small_gicp. Constrained motions and scale, which it does not offer, take a point-to-plane
iteration of the same form; its normal equations at the end also give the information matrix of every result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.normals import neighbours, normals_and_variation

ITERATIONS = 30


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
