"""From matched local features to poses: second-order spatial consistency (SC², Chen et al., CVPR 2022).

Two matches agree where the distance between their points is the same in both scans. A match's second-order agreement
with another one counts the matches that agree with both: chance agreement hardly survives that.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.motion import Motion, rotation_between

SEEDS, NEIGHBOURS = 40, 20
ROUNDS = 4  # of refitting a pose to its inliers
APART = 0.26  # rad: poses nearer than this and within two tolerances are one


def consensus(
    source: np.ndarray, target: np.ndarray, tolerance: float, count: int, motion: Motion
) -> tuple[np.ndarray, np.ndarray]:
    """Poses that many matches agree on, best first: source, target (C, 3) -> T (n <= count, 4, 4), inliers (n,).

    tolerance: how far a matched point may lie off, in the points' unit.
    """
    if len(source) < 3:
        return np.zeros((0, 4, 4)), np.zeros(0, int)
    agree = (np.abs(distances(source) - distances(target)) < tolerance).astype(np.float32)
    second = agree @ agree
    second *= agree
    T = poses_from_seeds(second, source, target, tolerance, motion, np.ones(len(source), np.float32))
    # Again without the matches of the best pose, so that there is always another one to compare it with.
    near = residuals(T, source, target) < tolerance
    left = (~near[near.sum(1).argmax()]).astype(np.float32)
    if left.sum() >= 3:
        T = np.concatenate([T, poses_from_seeds(second, source, target, tolerance, motion, left)])
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
    second: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, motion: Motion, use: np.ndarray
) -> np.ndarray:
    """A pose for each of the matches that most others agree with, fitted to its inliers: second (C, C) -> (S, 4, 4).

    use: (C,), 0 for matches that do not count.
    """
    seeds = np.argsort(-(second @ use) * use, kind="stable")[: min(SEEDS, int(use.sum()))]
    weight = second[seeds] * use
    members = np.argpartition(-weight, min(NEIGHBOURS, len(source)) - 1, axis=1)[:, :NEIGHBOURS]
    T = motion.fit(source[members], target[members], np.take_along_axis(weight, members, 1).astype(float))
    for _ in range(ROUNDS):
        near = residuals(T, source, target) < tolerance
        T = motion.fit(source[None], target[None], (near + 1e-9) * use)
    return T


def residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """|R s + t - q| of every match under every pose: T (B, 4, 4), (C, 3), (C, 3) -> (B, C)."""
    moved = (T[:, :3, :3].reshape(-1, 3) @ source.T).reshape(len(T), 3, -1)
    moved += T[:, :3, 3:]
    moved -= target.T
    return np.sqrt(np.einsum("bic,bic->bc", moved, moved))


def distances(points: np.ndarray) -> np.ndarray:
    """Between all points: (C, 3) -> (C, C) float32; float32 is exact enough for what is about their mean."""
    x = points.astype(np.float32)
    squared = (x * x).sum(1)
    d2 = (-2 * x) @ x.T
    d2 += squared
    d2 += squared[:, None]
    return np.sqrt(np.maximum(d2, 0, out=d2), out=d2)
