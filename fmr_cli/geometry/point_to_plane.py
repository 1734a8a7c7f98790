"""Point-to-plane: the distances of points from the planes of their partners, linearised about a pose.

Constrained motions and scale, which small_gicp's polish does not offer, are iterated here; the same normal equations
give the information matrix of every result, and the sequences' local map solves by them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.kernels import geman_mcclure
from fmr_cli.geometry.normals import neighbours, normals_and_variation

ITERATIONS = 30  # at most; from a refined pose it converges in about ten
SCALE = 3.0  # medians of |r|: the robust kernel's scale, 2 sigma of normal residuals
FACING = 0.7  # |cosine| between the normals of partners, at least: a table and its edge are none
STILL = 1e-9  # rad, and voxel edges: a step below it is rounding


def linearise(
    x: np.ndarray, y: np.ndarray, n: np.ndarray, pivot: np.ndarray, scale: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """r = n·(x - y), (..., N), and its derivative by the step (omega, v[, log s]) of ``step_motion``, (..., 6 or 7, N).

    x: moved points, y: points on the planes, n: unit normals, all (..., N, 3); pivot (3,): what the step turns about.
    A row a parameter, so that each is one contiguous pass.
    """
    (a, b, c), (nx, ny, nz) = np.moveaxis(x - pivot, -1, 0), np.moveaxis(n, -1, 0)
    rows = [b * nz - c * ny, c * nx - a * nz, a * ny - b * nx, nx, ny, nz]
    if scale:
        rows.append(a * nx + b * ny + c * nz)
    return np.einsum("...i,...i->...", n, x - y), np.stack(rows, -2)


def normal_equations(J: np.ndarray, r: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A = Σ w J Jᵀ and b = Σ w J r of ``linearise``: J (..., d, N), r and weight (..., N) -> (..., d, d), (..., d)."""
    return (J * weight[..., None, :]) @ J.swapaxes(-1, -2), (J @ (weight * r)[..., None])[..., 0]


def step_motion(step: np.ndarray, pivot: np.ndarray | None = None) -> np.ndarray:
    """The motion (..., 4, 4) of steps (omega, v[, log s]), (..., 6 or 7): x -> s R (x - pivot) + pivot + v.

    pivot: the origin by default. To first order that of the twist (omega, v), and the same subgroup; v stays the
    pivot's shift however far it turns.
    """
    pivot = np.zeros(3) if pivot is None else pivot
    M = np.zeros((*step.shape[:-1], 4, 4))
    R = Rotation.from_rotvec(step[..., :3]).as_matrix()  # a tenth of the time of ``se3.exp``
    if step.shape[-1] == 7:
        R = R * np.exp(step[..., 6, None, None])
    M[..., :3, :3], M[..., :3, 3], M[..., 3, 3] = R, pivot + step[..., 3:6] - R @ pivot, 1.0
    return M


def with_scale(basis: np.ndarray, scale: bool) -> np.ndarray:
    """The steps of ``basis`` (6, d), and with ``scale`` those of log s as well: (7, d + 1)."""
    if not scale:
        return basis
    B = np.zeros((7, basis.shape[1] + 1))
    B[:6, :-1], B[6, -1] = basis, 1
    return B


@dataclass
class Normal:
    """The normal equations of point-to-plane at poses: A = Σ w JᵀJ and b = Σ w Jᵀr over the step (omega, v, log s).

    A (..., 7, 7), b (..., 7). variance (...): of the weighted residuals, own unit squared. count (...): of
    correspondences.
    """

    A: np.ndarray
    b: np.ndarray
    variance: np.ndarray
    count: np.ndarray


def point_to_plane(
    source: np.ndarray,
    target: np.ndarray,
    normals: np.ndarray,
    tree: cKDTree,
    T: np.ndarray,
    reach: float,
    pivot: np.ndarray,
    facing: np.ndarray | None = None,
) -> Normal:
    """Linearise n·(T x - y) over nearest neighbours within reach, at many poses in one go.

    source: (..., N, 3), T: (..., 4, 4); the step turns (and scales) about ``pivot`` (3,). facing: the source's own
    normals (..., N, 3), where only partners that face along count.
    """
    moved = transform_points(T, source)
    distance, match = tree.query(moved, distance_upper_bound=reach)
    here = np.isfinite(distance)
    match = np.where(here, match, 0)
    y, n = target[match], normals[match]
    if facing is not None:
        here &= face_along(facing @ T[..., :3, :3].swapaxes(-1, -2), n)
    r, J = linearise(moved, y, n, pivot, scale=True)
    count, squared = here.sum(-1), r * r
    s2 = (SCALE * median(np.abs(r), here)) ** 2 + 1e-24 * reach**2  # copies fit to rounding
    w = np.where(here, geman_mcclure(squared, s2[..., None]), 0.0)
    return Normal(*normal_equations(J, r, w), (w * squared).sum(-1) / np.maximum(w.sum(-1), 1e-12), count)


def median(values: np.ndarray, here: np.ndarray) -> np.ndarray:
    """The median of those of values (..., N) that are ``here``, 0 of none: (...)."""
    if not values.size:
        return np.zeros(values.shape[:-1])
    ordered, last = np.sort(np.where(here, values, np.inf), axis=-1), here.sum(-1) - 1
    middle = np.stack([np.maximum(last, 0) // 2, (last + 1) // 2], -1)
    return np.where(last >= 0, np.take_along_axis(ordered, middle, -1).mean(-1), 0.0)


def face_along(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Which normals a and b (..., N, 3), of undetermined sign, agree: (..., N)."""
    return np.abs(np.einsum("...i,...i->...", a, b)) > FACING


def constrained(
    source: np.ndarray, target: np.ndarray, T: np.ndarray, edge: float, basis: np.ndarray, scale: bool
) -> np.ndarray:
    """Point-to-plane from T (4x4) within the span of basis (6, d), and with one scale factor where asked."""
    tree = cKDTree(target)
    normals = normals_and_variation(target, *neighbours(target, tree))[0]
    B = with_scale(basis, scale)
    free = len(B)
    pivot = target.mean(0)
    g = T.copy()
    for iteration in range(ITERATIONS):
        reach = edge * (2.0 if iteration < ITERATIONS // 2 else 1.0)
        normal = point_to_plane(source, target, normals, tree, g, reach, pivot)
        if normal.count < 6:
            return T
        A, b = normal.A[:free, :free], normal.b[:free]
        step = -B @ np.linalg.lstsq(B.T @ A @ B, B.T @ b, rcond=1e-12)[0]
        g = step_motion(step, pivot) @ g
        if np.abs(step[:3]).max() < STILL and np.abs(step[3:6]).max() < STILL * edge:
            break
    return g
