"""Points that two scans have in common, as parts or thinnings of one scan have: they fix a pose by themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.observability import Observations
from fmr_cli.geometry.sampling import OBLIQUE, sample

SOURCE, TARGET = 4_000, 12_000  # points that are looked at, about: of copies a few would do
STRIPS = 8  # across the target
NEAR = 0.5  # spacings, within which most points have their counterpart if the scans have points in common
# Spacings between counterparts at the pose that they give, median: coordinates that are rounded lie as far apart, two
# measurements of one place don't.
SAME = 0.1
STEPS = 8  # at most: two for copies; where not all is common, some points were near each other by chance
SPREAD = 3.0  # medians of the counterparts' distances: one further off was near by chance
ROUNDING = 1e-6  # spacings: copies lie as near to each other as that
LEAST = 10  # counterparts: fewer fix no pose


@dataclass(frozen=True)
class Counterparts:
    """source, target: (N, 3) the points in common, each in its own frame; T_target_source: the pose by these."""

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray

    def observed(self) -> Observations:
        """What the pose is held by: each point by its counterpart along three axes."""
        x, y = (np.tile(p, (3, 1)) for p in (transform_points(self.T_target_source, self.source), self.target))
        one = np.ones(len(x))
        return Observations(x, y, np.repeat(np.eye(3), len(self.source), axis=0), one, one)


def counterparts(
    source: np.ndarray, target: np.ndarray, T_target_source: np.ndarray, spacing: float, reach: float, seed: int
) -> Counterparts | None:
    """Those of points source and target (N, 3) near a pose; None unless most of the source's points have theirs.

    spacing: of the target's points; reach: of most of them from their middle. Least squares (Kabsch) between points
    that lie next to each other.
    """
    near, T, before = NEAR * spacing, T_target_source, np.empty(0)
    x, y = in_strips(source, target, T, 2 * reach / STRIPS, TARGET / max(len(target), TARGET), near)
    if len(y) < LEAST:
        return None
    x = sample(x, SOURCE, np.random.default_rng(seed))
    tree = cKDTree(y, balanced_tree=False, compact_nodes=False)
    for step in range(STEPS):
        distance, index = tree.query(transform_points(T, x), distance_upper_bound=near)
        here = np.flatnonzero(np.isfinite(distance))
        if len(here) < LEAST or (step == 0 and 2 * len(here) <= len(x)):
            return None
        apart = float(np.median(distance[here]))
        if np.array_equal(index, before):
            break
        T = Motion().fit(x[None, here], y[None, index[here]], np.ones((1, len(here))))[0]
        near, before = min(near, SPREAD * apart + ROUNDING * spacing), index
    return Counterparts(x[here], y[index[here]], T) if apart <= SAME * spacing else None


def in_strips(
    source: np.ndarray, target: np.ndarray, T_target_source: np.ndarray, period: float, share: float, margin: float
) -> tuple[np.ndarray, np.ndarray]:
    """The points of both that lie in thin strips through the target, about a ``share`` of it, ``period`` apart.

    A few of the points, and with each all that is near it: the source's strips are thinner by ``margin`` on both sides.
    """
    along = np.array(OBLIQUE)
    found = []
    for points, direction, shift, half in (
        (source, along @ T_target_source[:3, :3], along @ T_target_source[:3, 3], share / 2 - margin / period),
        (target, along, 0.0, share / 2),
    ):
        place = points @ (direction / period)
        place += shift / period
        place -= np.rint(place)
        found.append(points[np.flatnonzero(np.abs(place, out=place) <= half)])
    return found[0], found[1]
