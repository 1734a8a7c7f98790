"""From matched local features to poses: second-order spatial consistency (SC², Chen et al., CVPR 2022).

Two matches agree where the distance between their points is the same in both scans. A match's second-order agreement
with another one counts the matches that agree with both: chance agreement hardly survives that.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.pose_error import angle_between

SEEDS, NEIGHBOURS = 60, 20
POWER_STEPS = 4  # of the leading eigenvector: the order of the seeds has settled by then
ROUNDS = 4  # of refitting a pose to its inliers
BLOCK = 64  # rows of the matrix of agreement that are worked out at once: they stay in the processor's cache
APART = 0.26  # rad: poses nearer than this and within two tolerances are one


def consensus(
    source: np.ndarray, target: np.ndarray, tolerance: float, count: int, motion: Motion
) -> tuple[np.ndarray, np.ndarray]:
    """Poses that many matches agree on, best first: source, target (C, 3) -> T (n <= count, 4, 4), inliers (n,).

    tolerance: how far a matched point may lie off, in the points' unit.
    """
    if len(source) < 3:
        return np.zeros((0, 4, 4)), np.zeros(0, int)
    agree = agreeing(source, target, tolerance)
    T = poses_from_seeds(agree, source, target, tolerance, motion, np.ones(len(source), np.float32))
    # Again without the matches of the best pose, so that there is always another one to compare it with.
    near = residuals(T, source, target) < tolerance
    left = (~near[near.sum(1).argmax()]).astype(np.float32)
    if left.sum() >= 3:
        T = np.concatenate([T, poses_from_seeds(agree, source, target, tolerance, motion, left)])
    inliers = (residuals(T, source, target) < tolerance).sum(1)
    kept: list[int] = []
    moved = T[:, :3, :3] @ source.mean(0) + T[:, :3, 3]
    for i in np.argsort(-inliers, kind="stable"):
        turned = angle_between(T[i, :3, :3], T[kept, :3, :3]) > APART
        if np.all(turned | (np.linalg.norm(moved[i] - moved[kept], axis=-1) > 2 * tolerance)):
            kept.append(int(i))
        if len(kept) == count:
            break
    return T[kept], inliers[kept]


def poses_from_seeds(
    agree: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, motion: Motion, use: np.ndarray
) -> np.ndarray:
    """A pose for each seed, fitted to its inliers: agree (C, C), 1 where two matches agree -> (S, 4, 4).

    use: (C,), 0 for matches that do not count.
    """
    seeds = spread_seeds(agree, source, target, tolerance, use)
    second = (agree[seeds] @ agree) * agree[seeds] * use
    members = np.argpartition(-second, min(NEIGHBOURS, len(source)) - 1, axis=1)[:, :NEIGHBOURS]
    T = motion.fit(source[members], target[members], np.take_along_axis(second, members, 1).astype(float))
    for _ in range(ROUNDS):
        near = residuals(T, source, target) < tolerance
        T = motion.fit(source[None], target[None], (near + 1e-9) * use)
    return T


def spread_seeds(
    agree: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, use: np.ndarray
) -> np.ndarray:
    """The matches that most others agree with, of one place at most one: at most SEEDS indices.

    By the leading eigenvector of ``agree`` (spectral matching, Leordeanu and Hebert 2005), from a few power steps.
    """
    weight = use
    for _ in range(POWER_STEPS):
        weight = (agree @ weight) * use
        weight = weight / max(float(weight.max()), 1e-30)
    seeds: list[int] = []
    taken = use == 0
    p, q = np.ascontiguousarray(source.T), np.ascontiguousarray(target.T)
    for i in np.argsort(-weight, kind="stable"):
        if taken[i]:
            continue
        seeds.append(int(i))
        if len(seeds) == SEEDS:
            break
        near = np.ones(len(use), bool)
        for x in (*p, *q):  # coordinate by coordinate: a maximum over three is several times as slow
            near &= np.abs(x - x[i]) < tolerance
        taken |= near
    return np.array(seeds)


def residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """|R s + t - q| of every match under every pose: T (B, 4, 4), (C, 3), (C, 3) -> (B, C)."""
    moved = (T[:, :3, :3].reshape(-1, 3) @ source.T).reshape(len(T), 3, -1)
    moved += T[:, :3, 3:]
    moved -= target.T
    return np.sqrt(np.einsum("bic,bic->bc", moved, moved))


def agreeing(source: np.ndarray, target: np.ndarray, tolerance: float) -> np.ndarray:
    """1 where two matches are as far apart in both scans, else 0: source, target (C, 3) -> (C, C) float32."""
    x, y = source.astype(np.float32), target.astype(np.float32)
    agree = np.empty((len(x), len(x)), np.float32)
    for first in range(0, len(x), BLOCK):
        rows = slice(first, first + BLOCK)
        apart = distances(x, rows)
        apart -= distances(y, rows)
        agree[rows] = np.abs(apart, out=apart) < tolerance
    return agree


def distances(x: np.ndarray, rows: slice) -> np.ndarray:
    """From some points to all: (C, 3) float32 -> (rows, C); that is exact enough for what is about their mean."""
    squared = (x * x).sum(1)
    d2 = (-2 * x[rows]) @ x.T
    d2 += squared
    d2 += squared[rows, None]
    return np.sqrt(np.maximum(d2, 0, out=d2), out=d2)
