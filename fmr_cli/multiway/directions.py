"""Poses that bring the main directions of one scan onto those of another one.

What people build has walls, floors and ceilings along three directions at right angles (a Manhattan world, Coughlan and
Yuille 2003). Where two scans have them, the rotation is one of 24, and what is left to be found, the shift, a few
features tell that agree among many that don't: along a corridor, where consensus without a rotation finds the doors of
other rooms.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from fmr_cli.geometry.motion import Motion, rotations
from fmr_cli.geometry.pose_error import angle_between

ALONG, MOST = 0.97, 0.5  # |cosine| of a normal that lies along a direction (14 deg); share of normals that must
STARTS, STEPS = 16, 10  # of the search for the directions
NORMALS = 3_000  # of a scan that are looked at
NEAREST = 3  # of the other scan's keypoints by descriptor, that each keypoint votes for
CELL = 3.0  # voxel edges: of the grid that votes are counted in; a degree of error at 20 edges, and the keypoints' own
PEAKS = 12  # shifts that most features want, over all rotations
FITTED = 3.0  # voxel edges within which a vote counts in a peak's fit
OFF = 0.1  # rad: a rotation further from what ``dof`` allows is none


def turns() -> np.ndarray:
    """The 24 rotations (24, 3, 3) of a cube."""
    signed = (
        np.eye(3)[list(order)] * np.array(sign)
        for order in permutations(range(3))
        for sign in product((1, -1), repeat=3)
    )
    return np.stack([R for R in signed if np.linalg.det(R) > 0])


TURNS = turns()


def main_directions(normals: np.ndarray) -> np.ndarray | None:
    """Three directions at right angles, the columns of a rotation (3, 3), that most normals (N, 3) lie along; or None.

    From rotations spread evenly: each normal goes to its nearest axis, the axes to their normals' mean.
    """
    n = normals[:: max(len(normals) // NORMALS, 1)]
    R = rotations(STARTS)[:, :3, :3]
    for _ in range(STEPS):
        along = n @ R  # (S, N, 3) by BLAS, which einsum would not use
        weight = np.where(np.abs(along) == np.abs(along).max(2, keepdims=True), along, 0.0)
        weight = np.where(np.abs(weight) > 0.8, np.sign(weight), 0.0)  # beyond 37 deg it belongs to none
        U, _, Vt = np.linalg.svd(n.T @ weight)
        U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
        R = U @ Vt
    share = (np.abs(n @ R).max(2) > ALONG).mean(1)
    best = int(share.argmax())
    return R[best] if share[best] >= MOST else None


def turned(
    source: np.ndarray,
    target: np.ndarray,
    similarity: np.ndarray,
    directions: tuple[np.ndarray | None, np.ndarray | None],
    motion: Motion,
) -> np.ndarray:
    """Poses (n, 4, 4) between scans with main directions, at the shifts that most keypoints (K, 3), (L, 3) want.

    Lengths in voxel edges. similarity: (K, L) of descriptors. directions: of source and target.
    """
    if directions[0] is None or directions[1] is None or min(similarity.shape) <= NEAREST:
        return np.zeros((0, 4, 4))
    R = directions[1] @ TURNS @ directions[0].T
    R = R[angle_between(motion.rotation(R), R) < OFF]
    if not len(R):
        return np.zeros((0, 4, 4))
    near = np.argpartition(-similarity, NEAREST, axis=1)[:, :NEAREST]
    a, b = np.repeat(source, NEAREST, axis=0), target[near].reshape(-1, 3)  # a vote a row
    shifts = b - a @ np.swapaxes(R, 1, 2)  # [24 x V x 3]
    cells = np.floor(shifts / CELL).astype(np.int64)
    cells -= cells.min((0, 1))
    size = cells.max((0, 1)) + 1
    key = ((np.arange(len(R))[:, None] * size[0] + cells[..., 0]) * size[1] + cells[..., 1]) * size[2] + cells[..., 2]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    chosen = first[np.argsort(-count, kind="stable")[:PEAKS]]
    turn, middle = (
        chosen // len(a),
        (cells.reshape(-1, 3)[chosen] + 0.5) * CELL + CELL * np.floor(shifts / CELL).min((0, 1)),
    )
    agree = np.linalg.norm(shifts[turn] - middle[:, None], axis=2) < FITTED
    T = motion.fit(a[None], b[None], agree + 1e-9)
    return T[agree.sum(1) >= 3]
