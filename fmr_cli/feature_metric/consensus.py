"""From matched local features to poses: second-order spatial consistency (SC², Chen et al., CVPR 2022).

Two matches agree where the distance between their points is the same in both scans. A match's second-order agreement
with another one counts the matches that agree with both: chance agreement hardly survives that.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fmr_cli.feature_metric.motion import Motion, rotation_between

SEEDS, NEIGHBOURS = 40, 20
ROUNDS = 4  # of refitting a pose to its inliers
APART = 0.26  # rad: poses nearer than this and within two tolerances are one


def match(source: Tensor, target: Tensor) -> Tensor:
    """Pairs (C, 2) of descriptor rows, each the other side's nearest or nearest one way: (S, d), (T, d) -> (C, 2)."""
    similarity = source @ target.T
    forth = torch.stack([torch.arange(len(source)), similarity.argmax(1)], 1)
    back = torch.stack([similarity.argmax(0), torch.arange(len(target))], 1)
    return torch.unique(torch.cat([forth, back]), dim=0)


def consensus(source: Tensor, target: Tensor, tolerance: float, count: int, motion: Motion) -> tuple[Tensor, Tensor]:
    """Poses that many matches agree on, best first: source, target (C, 3) -> T (n <= count, 4, 4), inliers (n,).

    tolerance: how far a matched point may lie off, in the points' unit.
    """
    if len(source) < 3:
        return torch.zeros(0, 4, 4), torch.zeros(0)
    gap = (torch.cdist(source, source) - torch.cdist(target, target)).abs()
    agree = (gap < tolerance).float()
    second = agree * (agree @ agree)
    first = poses_from_seeds(second, source, target, tolerance, motion)
    # Again without the matches of the best pose, so that there is always another one to compare it with.
    best = residuals(first, source, target).lt(tolerance).sum(1).argmax()
    left = residuals(first[best : best + 1], source, target)[0] >= tolerance
    T = first
    if int(left.sum()) >= 3:
        others = poses_from_seeds(second[left][:, left], source[left], target[left], tolerance, motion)
        T = torch.cat([first, others])
    inliers = (residuals(T, source, target) < tolerance).sum(1).float()
    kept: list[int] = []
    centre = source.mean(0)
    moved = T[:, :3, :3] @ centre + T[:, :3, 3]
    for i in torch.argsort(-inliers, stable=True).tolist():
        if all(
            rotation_between(T[i, :3, :3], T[j, :3, :3]) > APART or (moved[i] - moved[j]).norm() > 2 * tolerance
            for j in kept
        ):
            kept.append(i)
        if len(kept) == count:
            break
    return T[kept], inliers[kept]


def poses_from_seeds(second: Tensor, source: Tensor, target: Tensor, tolerance: float, motion: Motion) -> Tensor:
    """A pose for each of the matches that most others agree with, fitted to its inliers: second (C, C) -> (S, 4, 4)."""
    seeds = torch.argsort(-second.sum(1), stable=True)[:SEEDS]
    weight, members = second[seeds].topk(min(NEIGHBOURS, len(source)), dim=1)
    T = motion.fit(source[members], target[members], weight)
    for _ in range(ROUNDS):
        error = residuals(T, source, target)
        T = motion.fit(source.expand(len(T), -1, -1), target.expand(len(T), -1, -1), (error < tolerance).float() + 1e-9)
    return T


def residuals(T: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """|R s + t - q| of every match under every pose: T (B, 4, 4), (C, 3), (C, 3) -> (B, C)."""
    return (source @ T[:, :3, :3].mT + T[:, None, :3, 3] - target).norm(dim=-1)
