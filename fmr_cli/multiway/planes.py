"""Poses that bring the walls, floors and ceilings of one scan onto those of another one, without any feature.

Along a bare corridor there is nothing to describe, and through a door little is seen of the next room; but planes are.
Where both scans have main directions the rotation is one of 24, and then the three shifts are apart: along each
direction, the histogram of the surfaces that face one way and that of those that face the other way say by which shift
the planes of one scan meet those of the other one. Most of the poses that they allow are wrong, and coincide well:
only what the scans see through tells (``visibility``).
"""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.pose_error import angle_between
from fmr_cli.multiway.directions import OFF, TURNS
from fmr_cli.multiway.visibility import Viewed

ALONG = 0.95  # |cosine| of a surface that counts as lying along a direction
SHIFTS = 12  # along each direction, the best first
POSES = 400  # over all rotations; the right one was hundredth where only a door joins two rooms


def poses(source: Viewed, target: Viewed, directions: tuple[np.ndarray, np.ndarray], motion: Motion) -> np.ndarray:
    """Poses T_target_source (n, 4, 4) at which most planes meet, best first; directions (3, 3) of source and target."""
    bin_width = 2 * max(source.edge, target.edge)
    axes = directions[1]
    R = axes @ TURNS @ directions[0].T
    R = R[angle_between(motion.rotation(R), R) < OFF]
    theirs = profiles(target.some @ axes, target.normals @ axes, bin_width)
    scores, T = [], []
    for turn in R:
        mine = profiles(source.some @ turn.T @ axes, source.normals @ turn.T @ axes, bin_width)
        along = [shifts(a, b) for a, b in zip(mine, theirs, strict=True)]  # for each axis scores and shifts
        x, y, z = np.ix_(*(score for score, _ in along))
        score = x + y + z
        best = np.argsort(-score, axis=None, kind="stable")[:POSES]
        chosen = np.unravel_index(best, score.shape)
        pose = np.tile(np.eye(4), (len(best), 1, 1))
        pose[:, :3, :3] = turn
        shift = np.stack([shift[k] for (_, shift), k in zip(along, chosen, strict=True)], axis=1)
        pose[:, :3, 3] = bin_width * shift @ axes.T
        scores.append(score.ravel()[best])
        T.append(pose)
    order = np.argsort(-np.concatenate(scores), kind="stable") if len(R) else np.zeros(0, int)
    return np.concatenate([np.zeros((0, 4, 4)), *T])[order[:POSES]]


def profiles(points: np.ndarray, normals: np.ndarray, bin_width: float) -> list[tuple[int, np.ndarray]]:
    """For each axis, the first bin and the histograms (2, bins) of surfaces that face back and forth along it.

    Roots of counts: a floor has many points, but is one plane.
    """
    found = []
    for axis in range(3):
        bins = np.floor(points[:, axis] / bin_width).astype(int)
        first, count = bins.min(), bins.max() - bins.min() + 1
        both = [np.bincount(bins[sign * normals[:, axis] > ALONG] - first, minlength=count) for sign in (-1, 1)]
        found.append((int(first), np.sqrt(np.stack(both))))
    return found


def shifts(source: tuple[int, np.ndarray], target: tuple[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Scores, 1 where all planes meet, and shifts in bins: the best SHIFTS of them, no two next to each other."""
    (first, a), (other, b) = source, target
    score = np.sum([np.correlate(y, x, "full") for x, y in zip(a, b, strict=True)], axis=0)
    score = score / max(float(np.sqrt((a**2).sum() * (b**2).sum())), 1e-12)
    padded = np.pad(score, 1, constant_values=-1)
    peaks = np.flatnonzero((score >= padded[:-2]) & (score > padded[2:]) & (score > 0))
    best = peaks[np.argsort(-score[peaks], kind="stable")[:SHIFTS]]
    return score[best], best - (a.shape[1] - 1) + other - first
