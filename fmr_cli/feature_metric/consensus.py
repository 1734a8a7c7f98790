"""From matched local features to poses: second-order spatial consistency (SC², Chen et al., CVPR 2022).

Two matches agree where the distance between their points is the same in both scans. A match's second-order agreement
with another one counts the matches that agree with both: chance agreement hardly survives that.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from fmr_cli.feature_metric.motion import Motion, rotation_between

SEEDS, NEIGHBOURS = 40, 20
ROUNDS = 4  # of refitting a pose to its inliers
APART = 0.26  # rad: poses nearer than this and within two tolerances are one


def match(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pairs (C, 2) of descriptor rows, each the other side's nearest or nearest one way: (S, d), (T, d) -> (C, 2)."""
    similarity = source @ target.T
    forth = np.arange(len(source)) * len(target) + similarity.argmax(1)
    back = similarity.argmax(0) * len(target) + np.arange(len(target))
    return np.stack(np.divmod(np.union1d(forth, back), len(target)), 1)


def consensus(
    source: np.ndarray, target: np.ndarray, tolerance: float, count: int, motion: Motion
) -> tuple[np.ndarray, np.ndarray]:
    """Poses that many matches agree on, best first: source, target (C, 3) -> T (n <= count, 4, 4), inliers (n,).

    tolerance: how far a matched point may lie off, in the points' unit.
    """
    if len(source) < 3:
        return np.zeros((0, 4, 4)), np.zeros(0, int)
    agree = (np.abs(cdist(source, source) - cdist(target, target)) < tolerance).astype(np.float32)
    second = agree * (agree @ agree)
    T = poses_from_seeds(second, source, target, tolerance, motion)
    # Again without the matches of the best pose, so that there is always another one to compare it with.
    near = residuals(T, source, target) < tolerance
    left = ~near[near.sum(1).argmax()]
    if left.sum() >= 3:
        others = poses_from_seeds(second[np.ix_(left, left)], source[left], target[left], tolerance, motion)
        T = np.concatenate([T, others])
    inliers = (residuals(T, source, target) < tolerance).sum(1)
    kept: list[int] = []
    moved = T[:, :3, :3] @ source.mean(0) + T[:, :3, 3]
    for i in np.argsort(-inliers, kind="stable"):
        turned = rotation_between(T[i, :3, :3], T[kept, :3, :3]) > APART
        if np.all(turned | (np.linalg.norm(moved[i] - moved[kept], axis=-1) > 2 * tolerance)):
            kept.append(int(i))
        if len(kept) == count:
            break
    return T[kept], inliers[kept]


def poses_from_seeds(
    second: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, motion: Motion
) -> np.ndarray:
    """A pose for each of the matches that most others agree with, fitted to its inliers: second (C, C) -> (S, 4, 4)."""
    seeds = np.argsort(-second.sum(1), kind="stable")[:SEEDS]
    members = np.argsort(-second[seeds], axis=1, kind="stable")[:, :NEIGHBOURS]
    T = motion.fit(source[members], target[members], np.take_along_axis(second[seeds], members, 1).astype(float))
    for _ in range(ROUNDS):
        near = residuals(T, source, target) < tolerance
        T = motion.fit(source[None], target[None], near + 1e-9)
    return T


def residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """|R s + t - q| of every match under every pose: T (B, 4, 4), (C, 3), (C, 3) -> (B, C)."""
    return np.linalg.norm(source @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3] - target, axis=-1)
