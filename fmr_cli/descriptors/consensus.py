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
BLOCK = 64  # matches that are compared with others at once: what that takes stays in the processor's cache
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
    T = poses_from_seeds(agree, source, target, tolerance, motion, np.ones(len(source), bool))
    # Again without the matches of the best pose, so that there is always another one to compare it with.
    near = within(T, source, target, tolerance)
    left = ~near[near.sum(1).argmax()]
    if left.sum() >= 3:
        T = np.concatenate([T, poses_from_seeds(agree, source, target, tolerance, motion, left)])
    inliers = within(T, source, target, tolerance).sum(1)
    kept: list[int] = []
    moved = T[:, :3, :3] @ source.mean(0) + T[:, :3, 3]
    new = np.ones(len(T), bool)  # which are none of those kept, nor near them
    for i in np.argsort(-inliers, kind="stable"):
        if not new[i]:
            continue
        kept.append(int(i))
        if len(kept) == count:
            break
        turned = angle_between(T[i, :3, :3], T[:, :3, :3]) > APART
        new &= turned | (np.linalg.norm(moved - moved[i], axis=1) > 2 * tolerance)
    return T[kept], inliers[kept]


def poses_from_seeds(
    agree: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, motion: Motion, use: np.ndarray
) -> np.ndarray:
    """A pose for each seed, fitted to its inliers: agree (C, C), 1 where two matches agree -> (S, 4, 4).

    use: (C,), False for matches that do not count.
    """
    rows = agree if use.all() else agree[use]
    seeds = spread_seeds(rows, source, target, tolerance, use)
    second = np.zeros((len(seeds), len(source)), np.float32)
    second[:, use] = agree[seeds] @ rows.T
    second *= agree[seeds]
    members = np.argpartition(-second, min(NEIGHBOURS, len(source)) - 1, axis=1)[:, :NEIGHBOURS]
    T = motion.fit(source[members], target[members], np.take_along_axis(second, members, 1).astype(float))
    source, target = source[use], target[use]
    going, before = np.arange(len(T)), np.zeros((len(T), 0), bool)
    for _ in range(ROUNDS):
        near = within(T[going], source, target, tolerance)
        if before.size:  # a pose that has the same inliers as before stays where it is
            changed = (near != before).any(1)
            going, near = going[changed], near[changed]
        if not len(going):
            break
        T[going], before = motion.fit(source[None], target[None], near + 1e-9), near
    return T


def spread_seeds(
    rows: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, use: np.ndarray
) -> np.ndarray:
    """The matches that most others agree with, of one place at most one: at most SEEDS indices.

    By the leading eigenvector of the matrix of agreement (spectral matching, Leordeanu and Hebert 2005), from a few
    power steps. rows: (U, C) of that matrix, those of the matches that are in ``use`` (C,).
    """
    weight = use.astype(np.float32)
    for _ in range(POWER_STEPS):
        found = rows @ weight
        weight[use] = found / max(float(found.max()), 1e-30)
    order = np.argsort(-weight, kind="stable")[: len(rows)]
    order = order[use[order]]
    places = np.hstack([source, target])
    seeds: list[int] = []
    for first in range(0, len(order), BLOCK):
        some = order[first : first + BLOCK]
        taken = np.logical_or.reduce(near_each_other(places[some], places[seeds], tolerance), 1)
        near = near_each_other(places[some], places[some], tolerance)
        for i in range(len(some)):
            if not taken[i]:
                seeds.append(int(some[i]))
                taken |= near[i]
            if len(seeds) == SEEDS:
                return np.array(seeds)
    return np.array(seeds)


def near_each_other(a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    """Which of a (A, d) and b (B, d) differ by less than ``tolerance`` in each coordinate: (A, B)."""
    near = np.ones((len(a), len(b)), bool)
    for x, y in zip(a.T, b.T, strict=True):  # one by one: a maximum over all is several times as slow
        near &= np.abs(x[:, None] - y) < tolerance
    return near


def within(T: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float) -> np.ndarray:
    """Which matches lie within ``tolerance`` under which pose: T (B, 4, 4), (C, 3), (C, 3) -> (B, C).

    |R s + t - q|² = |s|² + |q|² + |t|² + 2 (Rᵀt)·s - 2 t·q - 2 Σ R_ij q_i s_j, which is one matrix product.
    """
    R, t = T[:, :3, :3], T[:, :3, 3]
    squares = (source * source).sum(1) + (target * target).sum(1)
    matches = np.vstack([squares, source.T, target.T, (target[:, :, None] * source[:, None]).reshape(-1, 9).T])
    back = (t[:, None] @ R)[:, 0]
    poses = np.hstack([np.ones((len(T), 1)), 2 * back, -2 * t, -2 * R.reshape(-1, 9)])
    return poses @ matches < (tolerance**2 - (t * t).sum(1))[:, None]


def agreeing(source: np.ndarray, target: np.ndarray, tolerance: float) -> np.ndarray:
    """1 where two matches are as far apart in both scans, else 0: source, target (C, 3) -> (C, C) float32."""
    x, y = source.astype(np.float32), target.astype(np.float32)
    agree = np.empty((len(x), len(x)), np.float32)
    for first in range(0, len(x), BLOCK):
        apart = distances(x[first:], BLOCK)
        apart -= distances(y[first:], BLOCK)
        agree[first : first + BLOCK, first:] = np.abs(apart, out=apart) < tolerance
        agree[first:, first : first + BLOCK] = agree[first : first + BLOCK, first:].T
    return agree


def distances(x: np.ndarray, count: int) -> np.ndarray:
    """From the first ``count`` points to all: (C, 3) float32 -> (count, C); exact enough about their mean."""
    squared = (x * x).sum(1)
    d2 = (-2 * x[:count]) @ x.T
    d2 += squared
    d2 += squared[:count, None]
    return np.sqrt(np.maximum(d2, 0, out=d2), out=d2)
