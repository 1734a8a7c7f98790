"""From matched local features to poses: second-order spatial consistency (SC², Chen et al., CVPR 2022).

Two matches agree where the distance between their points is the same in both scans. A match's second-order agreement
with another one counts the matches that agree with both: chance agreement hardly survives that.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.motion import Motion, moments

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
    products = moments(source, target)
    T = poses_from_seeds(agree, source, target, products, tolerance, motion, np.ones(len(source), bool))
    # Again without the matches of the best pose, so that there is always another one to compare it with.
    near = within(T, products, tolerance)
    left = ~near[near.sum(1).argmax()]
    if left.sum() >= 3:
        others = poses_from_seeds(agree, source, target, products, tolerance, motion, left)
        T, near = np.concatenate([T, others]), np.concatenate([near, within(others, products, tolerance)])
    inliers = near.sum(1)
    alike = alike_at(T, source.mean(0), 2 * tolerance)
    kept: list[int] = []
    new = np.ones(len(T), bool)  # which are none of those kept, nor near them
    for i in np.argsort(-inliers, kind="stable"):
        if new[i] and len(kept) < count:
            kept.append(int(i))
            new &= ~alike[i]
    return T[kept], inliers[kept]


def alike_at(T: np.ndarray, point: np.ndarray, reach: float) -> np.ndarray:
    """Which of poses (S, 4, 4) turn by less than APART to each other and take a point (3,) to within reach: (S, S)."""
    R = T[:, :3, :3].reshape(-1, 9)
    moved = T[:, :3, :3] @ point + T[:, :3, 3]
    off = moved[:, None] - moved
    trace = R @ R.T  # of the rotations between them: 1 + 2 cos of their angle
    return (np.arccos(np.clip((trace - 1) / 2, -1, 1)) <= APART) & (np.einsum("ijk,ijk->ij", off, off) <= reach**2)


def poses_from_seeds(
    agree: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    products: np.ndarray,
    tolerance: float,
    motion: Motion,
    use: np.ndarray,
) -> np.ndarray:
    """A pose for each seed, fitted to its inliers: agree (C, C), 1 where two matches agree -> (S, 4, 4).

    products: the matches' ``moments`` (C, 16); use: (C,), False for matches that do not count.
    """
    seeds = spread_seeds(agree, source, target, tolerance, use)
    second = agree[seeds] @ agree
    second *= agree[seeds]
    second *= use
    members = np.argpartition(-second, min(NEIGHBOURS, len(source)) - 1, axis=1)[:, :NEIGHBOURS]
    T = motion.fit(source[members], target[members], np.take_along_axis(second, members, 1).astype(float))
    products = products[use]
    going, before = np.arange(len(T)), np.zeros((len(T), 0), bool)
    for _ in range(ROUNDS):
        near = within(T[going], products, tolerance)
        if before.size:  # a pose that has the same inliers as before stays where it is
            changed = (near != before).any(1)
            going, near = going[changed], near[changed]
        if not len(going):
            break
        T[going], before = motion.fit_sums((near + 1e-9) @ products), near
    return T


def spread_seeds(
    agree: np.ndarray, source: np.ndarray, target: np.ndarray, tolerance: float, use: np.ndarray
) -> np.ndarray:
    """The matches that most others agree with, of one place at most one: at most SEEDS indices.

    By the leading eigenvector of the matrix of agreement (spectral matching, Leordeanu and Hebert 2005), from a few
    power steps. use: (C,), False for matches that do not count.
    """
    weight = use.astype(np.float32)
    for _ in range(POWER_STEPS):
        found = (agree @ weight) * use
        weight = found / max(float(found.max()), 1e-30)
    order = np.argsort(-weight, kind="stable")[: np.count_nonzero(use)]
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


def within(T: np.ndarray, products: np.ndarray, tolerance: float) -> np.ndarray:
    """Which matches lie within ``tolerance`` under which pose: T (B, 4, 4), ``moments`` (C, 16) -> (B, C).

    |R s + t - q|² = |s|² + |q|² + |t|² + 2 (Rᵀt)·s - 2 t·q - 2 Σ R_ij q_i s_j, which is one matrix product.
    """
    R, t = T[:, :3, :3], T[:, :3, 3]
    squares = (products[:, 1:7] ** 2).sum(1)
    back = (t[:, None] @ R)[:, 0]
    poses = np.hstack([(t * t).sum(1)[:, None], 2 * back, -2 * t, -2 * R.reshape(-1, 9)])
    return poses @ products.T < tolerance**2 - squares


def agreeing(source: np.ndarray, target: np.ndarray, tolerance: float) -> np.ndarray:
    """1 where two matches are as far apart in both scans, else 0: source, target (C, 3) -> (C, C) float32."""
    x, y = squared_distances(source), squared_distances(target)
    agree = np.empty((len(source), len(source)), np.float32)
    for first in range(0, len(source), BLOCK):
        apart = distances(*x, first)
        apart -= distances(*y, first)
        agree[first : first + BLOCK, first:] = np.abs(apart, out=apart) < tolerance
        agree[first:, first : first + BLOCK] = agree[first : first + BLOCK, first:].T
    return agree


def squared_distances(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two factors (C, 5) and (5, C) whose product is points' squared distances, float32; exact enough about their mean.

    |a - b|² = |a|² + |b|² - 2 a·b, all of it as one product.
    """
    x = points.astype(np.float32)
    one, squared = np.ones((len(x), 1), np.float32), (x * x).sum(1, keepdims=True)
    return np.hstack([x, squared, one]), np.ascontiguousarray(np.hstack([-2 * x, one, squared]).T)


def distances(a: np.ndarray, b: np.ndarray, first: int) -> np.ndarray:
    """From BLOCK points to all from ``first`` on, by the factors of ``squared_distances``: (BLOCK, C - first)."""
    d2 = a[first : first + BLOCK] @ b[:, first:]
    return np.sqrt(np.maximum(d2, 0, out=d2), out=d2)
