"""Is a pose right? The evidence at it, the odds that this gives, and what rivals leave of them.

A pose may be wrong in two ways: the scans do not belong together there, or they fit as well elsewhere. So its
confidence is a product. Its support, by logistic regression on all the evidence, says how likely a pose that fits like
this one is right if it has no rival. Among rivals counts alone how well each fits in its own common region: a facade
that is shifted by a bay shows the more of itself the more it overlaps, and is no more right for it.

The evidence is dimensionless. The weights come from ``python -m benchmarks.calibrate``, fitted on made-up scans that
no test uses.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.registration.agreement import Agreement, agreement
from fmr_cli.registration.pair import Pair

ALIGNED = 0.8  # confidence from which a pose is called aligned: beyond what a person would check
# `python -m benchmarks.calibrate`: of ``Evidence.vector``
SUPPORT = np.array([-3.659, 0.856, 1.301, 0.0, 0.293, 0.0, 0.309, 2.316, 0.0])
FIT = np.array([0.829, 0.0, 1.642])  # of ``Evidence.quality``
MOST_STRETCH = 0.05  # a stretch beyond it is as bad
SURE_LOGIT = 50.0  # beyond it exp() has no more to say

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Evidence(Agreement):
    """What speaks for a pose: how the surfaces agree, and how many matches of local features do.

    votes: matches that agree, whether or not the pose came from them. repeats: how much of the scene repeats itself
    elsewhere, see ``hypotheses.rivals``.
    """

    votes: int
    repeats: float = 0.0

    def quality(self) -> np.ndarray:
        """How well the surfaces fit where they meet, more is better: (3,)."""
        ratios = [1 / self.offset, 1 / self.turn, (self.explained + 10) / (self.contradicted + 10)]
        return np.log(np.clip(ratios, 1e-3, 1e3))

    def vector(self) -> np.ndarray:
        """What the logistic model sees, after a 1 for the intercept: of each kind of evidence, more is better."""
        share, points = max(self.explained_share, 1e-2), (self.explained + 10) / 400
        against = -100 * min(self.stretch, MOST_STRETCH)
        return np.array(
            [1.0, np.log1p(self.votes), *self.quality(), np.log(share), np.log(points), against, -self.repeats]
        )


def support(evidence: Evidence) -> float:
    """The probability that a pose with this evidence is right if it has no rival."""
    return float(1 / (1 + np.exp(-np.clip(SUPPORT @ evidence.vector(), -SURE_LOGIT, SURE_LOGIT))))


def confidences(evidence: Sequence[Evidence]) -> list[float]:
    """The probability of each of several distinct poses, of which at most one is right."""
    supports = np.array([support(e) for e in evidence])
    fits = np.array([FIT @ e.quality() for e in evidence])
    weights = supports * np.exp(np.clip(fits - fits.max(initial=-np.inf), -SURE_LOGIT, 0.0))
    return (supports * weights / max(weights.sum(), 1e-300)).tolist()


@dataclass
class Candidate:
    """A refined pose between the centred frames, with what speaks for it.

    start: where it came from; errors: mean |r| of the IC solver that led to it. support: see ``support``; confidence:
    that it is right, given the other candidates; set once these are known.
    """

    T_target_source: np.ndarray
    start: str
    errors: list[float]
    evidence: Evidence
    support: float = 0.0
    confidence: float = 0.0


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
        evidence = Evidence(**asdict(found), votes=self.pair.inlier_count(T_target_source), repeats=self.repeats)
        new = Candidate(T_target_source, start, errors, evidence, support(evidence))
        log.debug("%s: support %.3f, %s", start, new.support, evidence)
        kept: list[Candidate] = []
        for c in sorted([*self.candidates, new], key=lambda c: -c.evidence.explained * c.support):
            if not any(self.pair.same(c.T_target_source, k.T_target_source) for k in kept):
                kept.append(c)
        self.weigh(kept)

    def weigh(self, candidates: list[Candidate]) -> None:
        """Each candidate's confidence given the others; best first."""
        shares = confidences([c.evidence for c in candidates])
        weighed = [replace(c, confidence=p) for c, p in zip(candidates, shares, strict=True)]
        self.candidates = sorted(weighed, key=lambda c: -c.confidence)

    def found_repeats(self, repeats: float) -> None:
        """Take into account how much of the scene repeats itself."""
        self.repeats = max(self.repeats, repeats)
        evidence = [replace(c.evidence, repeats=self.repeats) for c in self.candidates]
        self.weigh([
            replace(c, evidence=e, support=support(e)) for c, e in zip(self.candidates, evidence, strict=True)
        ])  # fmt: skip

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


def doubts(pair: Pair, best: Candidate, rivals: Sequence[Candidate]) -> list[str]:
    """Why a pose is not beyond doubt, in words, the weightiest first. rivals: poses that fit about as well."""
    e, said = best.evidence, []
    if rivals:
        more = f", and {len(rivals) - 1} more" if len(rivals) > 1 else ""
        said.append(f"fits about as well {in_words(pair, best, rivals[0])}{more}")
    against = e.contradicted / max(e.explained + e.contradicted, 1)
    if against > CONTRADICTED:
        said.append(f"{against:.0%} of what both scans saw contradicts the pose")
    if e.stretch > STRETCHED:
        said.append(f"fits better with the source scaled by {e.stretch:.1%}: is one of the two in another scale?")
    if e.offset > ROUGH:
        said.append(f"the surfaces lie {e.offset:.1f} times as far apart as their own roughness explains")
    if e.explained_share < SMALL:
        said.append(f"only {e.explained_share:.0%} of the smaller scan lies on the other one")
    if e.votes < FEW:
        said.append(f"only {e.votes} matches of local features agree with it")
    return said


# From where on a kind of evidence is worth a word; they explain a verdict and do not make it.
CONTRADICTED, STRETCHED, ROUGH, SMALL, FEW = 0.1, 0.005, 1.8, 0.2, 12
TURNED = 5.0  # degrees: rivals turned by less are told by their shift


def in_words(pair: Pair, best: Candidate, rival: Candidate) -> str:
    """Where a rival puts the source, as seen from the best pose, in the target's axes."""
    motion = rival.T_target_source @ np.linalg.inv(best.T_target_source)
    angle = angle_degrees(motion)
    if angle > TURNED:
        R = motion[:3, :3]
        axis = np.linalg.eigh(R + R.T)[1][:, 2]  # of eigenvalue 2
        return f"turned by {angle:.0f} deg about {direction(axis)}"
    centre = transform_points(best.T_target_source, pair.s.points.mean(0)[None])
    shift = (transform_points(motion, centre) - centre)[0]
    return f"shifted by {np.linalg.norm(shift):.3g} along {direction(shift)}"


def direction(v: np.ndarray) -> str:
    """A direction in words, its largest component positive."""
    v = v / max(float(np.linalg.norm(v)), 1e-300)
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(v, 2) + 0.0))  # no -0.00
