"""Is the pose right? Evidence gathered at it, and the probability that it gives.

The evidence is dimensionless: distances count in voxel edges, feature errors against the features' own size. The
weights come from ``python -m benchmarks.calibrate``, fitted on procedural scenes that no test uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from fmr_cli.geometry.surface import Surface
from fmr_cli.registration.pair import Pair

ALIGNED = 0.5  # confidence from which a pose is called aligned
TOUCHING = 1.5  # voxel edges
FLOOR = 0.01  # offsets in voxel edges, and turns: less than that is as good as none


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    overlap: share of the smaller scan within TOUCHING of the other one. inlier_rmse: of those, own unit.
    offset: how far touching points lie off each other's tangent planes, root mean square, over how far a surface's own
        neighbours do.
    turn: the mean of 1 - |cosine| between their normals, over the same. Both are about 1 or less where the scans are
        samples of one surface, whatever its curvature and noise.
    votes: how many matches of local features agree with the pose, whether or not it came from them.
    fit_over_rival: the share of the source that coincides with the target, normals too, over the most at other poses:
        those that matches agree on, and some as good as random.
    """

    overlap: float
    inlier_rmse: float
    offset: float
    turn: float
    votes: int
    fit_over_rival: float

    def vector(self) -> np.ndarray:
        """What the logistic model sees, after a 1 for the intercept: of each kind of evidence, more is better."""
        ratios = [1 / self.offset, 1 / self.turn, self.fit_over_rival]
        return np.array([1.0, np.log1p(self.votes), *np.log(np.clip(ratios, 1e-2, 1e2))])


def fit(source: Surface, target: Surface, T: np.ndarray) -> dict[str, float]:
    """How the surfaces fit at T (4x4, source to target, in their frames), both on the same voxel edge.

    Returns the ``Evidence`` that geometry gives: overlap, inlier_rmse, offset, turn.
    """
    shares, sums = [], np.zeros(6)
    for a, b, g in ((source, target, T), (target, source, np.linalg.inv(T))):
        moved = a.points @ g[:3, :3].T + g[:3, 3]
        distance, index = b.tree.query(moved, distance_upper_bound=TOUCHING * target.edge)
        here = np.flatnonzero(np.isfinite(distance))
        there = index[here]
        off = np.einsum("ni,ni->n", moved[here] - b.points[there], b.normals[there]) / target.edge
        turn = 1 - np.abs(np.einsum("ni,ni->n", a.normals[here] @ g[:3, :3].T, b.normals[there]))
        own_off, own_turn = b.unevenness[0][there] / target.edge, b.unevenness[1][there]
        sums += [len(here), (distance[here] ** 2).sum(), off @ off, own_off @ own_off, turn.sum(), own_turn.sum()]
        shares.append(len(here) / len(distance))
    count = max(sums[0], 1.0)
    square, off2, own_off2, turns, own_turns = sums[1:] / count
    return {
        "overlap": max(shares),
        "inlier_rmse": float(np.sqrt(square)) if sums[0] else float("inf"),
        "offset": float(np.sqrt((off2 + FLOOR**2) / (own_off2 + FLOOR**2))),
        "turn": float((max(turns, 0) + FLOOR) / (own_turns + FLOOR)),
    }


# `python -m benchmarks.calibrate --pairs 240 --seed 42000`
WEIGHTS = np.array([-7.358, 2.229, 2.275, 1.513, 2.211])


def odds(evidence: Evidence) -> float:
    """The odds that the pose is right and not none at all: logistic regression on the evidence."""
    return float(np.exp(np.clip(WEIGHTS @ evidence.vector(), -50, 50)))


def confidences(odds: Sequence[float]) -> list[float]:
    """The probability of each of several distinct poses, of which at most one is right: the odds share out 1."""
    return [o / (1 + sum(odds)) for o in odds]


@dataclass
class Candidate:
    """A refined pose between the centred frames, with what speaks for it.

    start: where it came from; errors: mean |r| of the IC solver that led to it. confidence: that it is right, given the
    other candidates; set once these are known.
    """

    T_target_source: np.ndarray
    start: str
    errors: list[float]
    evidence: Evidence
    confidence: float = 0.0

    @cached_property
    def odds(self) -> float:
        return odds(self.evidence)


@dataclass
class Judge:
    """Weighs the poses of one pair against each other.

    rivals: poses, each with its overlap score, that a right pose has to fit better than: those that matches agree on,
    and some as good as random.
    """

    pair: Pair
    rivals: list[tuple[np.ndarray, float]] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)

    def consider(self, T_target_source: np.ndarray, start: str, errors: list[float]) -> None:
        """Gather the evidence at a pose, and weigh all candidates anew."""
        T = T_target_source
        others = [score for rival, score in self.rivals if not self.pair.same(T, rival)]
        evidence = Evidence(
            **fit(self.pair.s, self.pair.t, T),
            votes=self.pair.inlier_count(T),
            fit_over_rival=self.pair.overlap_score(T) / max(*others, 1e-3),
        )
        self.candidates = weighed([*self.candidates, Candidate(T, start, errors, evidence)], self.pair)

    @property
    def best(self) -> Candidate:
        return self.candidates[0]

    def sure(self, confidence: float) -> bool:
        """Whether the best candidate has that confidence."""
        return bool(self.candidates) and self.best.confidence >= confidence


def weighed(candidates: list[Candidate], pair: Pair) -> list[Candidate]:
    """The candidates, best first, without those that are a better one's pose; each confidence given the others."""
    kept: list[Candidate] = []
    for c in sorted(candidates, key=lambda c: -c.odds):
        if not any(pair.same(c.T_target_source, k.T_target_source) for k in kept):
            kept.append(c)
    return [replace(c, confidence=p) for c, p in zip(kept, confidences([c.odds for c in kept]), strict=True)]
