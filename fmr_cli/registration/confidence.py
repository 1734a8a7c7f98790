"""Is a pose right? The evidence at it, the odds that this gives, and what other poses leave of them.

The evidence is dimensionless. The weights come from ``python -m benchmarks.calibrate``, fitted on made-up scans that
no test uses.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property

import numpy as np

from fmr_cli.registration.agreement import Agreement, agreement
from fmr_cli.registration.pair import Pair

ALIGNED = 0.7  # confidence from which a pose is called aligned

# `python -m benchmarks.calibrate --pairs 240 --seed 42000`
WEIGHTS = np.array([-1.0, 0.8, 1.0, 0.5, 2.0, 1.0])

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Evidence(Agreement):
    """What speaks for a pose: how the surfaces agree, and how many matches of local features do.

    votes: matches, whether or not the pose came from them.
    """

    votes: int

    def vector(self) -> np.ndarray:
        """What the logistic model sees, after a 1 for the intercept: of each kind of evidence, more is better."""
        ratios = [
            1 / self.offset, 1 / self.turn, (self.explained + 1) / (self.contradicted + 1),
            max(self.explained_share, 1e-3),
        ]  # fmt: skip
        return np.array([1.0, np.log1p(self.votes), *np.log(np.clip(ratios, 1e-3, 1e3))])


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
        """``odds`` of its evidence."""
        return odds(self.evidence)


@dataclass
class Judge:
    """Weighs the poses of one pair against each other.

    candidates: distinct poses, best first. repeats: how much of the scene repeats itself, see ``hypotheses.rivals``.
    """

    pair: Pair
    repeats: float = 0.0
    candidates: list[Candidate] = field(default_factory=list)

    def consider(self, T_target_source: np.ndarray, start: str, errors: list[float]) -> None:
        """Gather the evidence at a pose, and weigh all candidates anew."""
        found = agreement(self.pair.s, self.pair.t, T_target_source)
        evidence = Evidence(**asdict(found), votes=self.pair.inlier_count(T_target_source))
        new = Candidate(T_target_source, start, errors, evidence)
        log.debug("%s: odds %.3g, %s", start, new.odds, evidence)
        kept: list[Candidate] = []
        for c in sorted([*self.candidates, new], key=lambda c: -c.odds):
            if not any(self.pair.same(c.T_target_source, k.T_target_source) for k in kept):
                kept.append(c)
        shares = confidences([c.odds for c in kept])
        self.candidates = [replace(c, confidence=p) for c, p in zip(kept, shares, strict=True)]

    def knows(self, T_target_source: np.ndarray) -> bool:
        """Whether a candidate has that pose already."""
        return any(self.pair.same(T_target_source, c.T_target_source) for c in self.candidates)

    @property
    def best(self) -> Candidate:
        """The candidate that is most likely right."""
        return self.candidates[0]

    def sure(self, confidence: float) -> bool:
        """Whether the best candidate has that confidence."""
        return bool(self.candidates) and self.best.confidence >= confidence
