"""Is a pose right? The evidence at it, what rivals leave of it, and the probability that this gives.

A pose may be wrong in two ways: the scans do not belong together there, or they fit as well elsewhere. The first is
told by its support, a logistic regression on all the evidence at it. Among rivals counts alone how well each fits in
its own common region: a facade that is shifted by a bay shows the more of itself the more it overlaps, and is no more
right for it. What then stands first is judged by its evidence, its margin over the rivals and their products, again by
logistic regression.

The evidence is dimensionless. The weights are in ``models/verdict.json``, fitted by ``python -m benchmarks.calibrate``
on made-up scans that no test uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.geometry.observability import direction
from fmr_cli.registration.agreement import Agreement, agreement
from fmr_cli.registration.models import model
from fmr_cli.registration.pair import Pair
from fmr_cli.registration.verdict_weights import Weights

ALIGNED = 0.7  # confidence from which a pose is called aligned
MOST_STRETCH = 0.05  # a stretch beyond it is as bad
AS_GOOD = 1.5  # times as close as a surface's own neighbours: beyond, points are the same, and no surer for it
# What no other evidence outweighs, and the confidence that it leaves at most; by the looks at 1,400 made-up pairs, bent
# ones too (`python -m benchmarks.calibrate` counts them). Such pairs are too few for the weights to say so themselves.
OTHER_SCALE, IN_OTHER_SCALE = 0.02, 0.1  # a stretch beyond it: 5 of 4123 right poses had that
DENIED = 0.1  # more contradicted than explained: 1 of 94 poses that stood first was right
# More than a third as many points missing as explained (1 : e): 16 of 352 were right. Furniture that was moved,
# another scale, another place of the like.
LACKING_MUCH, IF_LACKING = 1.0, 0.3
# Less than a tenth of the smaller scan explained: 15 of 40 were right, and streets turned end to end fit so.
SCANT, IF_SCANT = 0.1, 0.5
# Fewer points of detail than that, hardly more than a corner, which fits any other: 39 of 356 were right.
BARE, IF_BARE = 5, 0.3
# A rival that has ABOUT as much support and weighs NEARLY as much, where no thing stands out that one scan lacks (the
# largest has less than STANDS_OUT times as many points as the pose's own): one of the like may stand first for being
# seen from the same side in both scans, as bays of a rack. Wrong is SO_MANY times as likely then, by hand: on 1,400
# pairs, before the looks of today, 12 of 667 aligned ones were wrong at full looks, 19 of 683 without it.
ABOUT, NEARLY, STANDS_OUT, SO_MANY = 0.9, 0.1, 2.0, 4.0
# Times the odds of a pose that a thing tells from its rivals (``distinction``). Of 5,216 looks at calibration pairs 52
# had one: 50 of these were right, at 0.65 of confidence in the mean, for which 28 to 39 times would be most likely;
# taken with care, as they are few (a script that is not in the project).
TOLD = 10.0
BY_CHANCE = 3  # points of the largest cluster that edges make: too few to be told from none
SURE_LOGIT = 50.0  # beyond it exp() has no more to say
LIKELY = 0.5  # support from which a pose would be called right if it were alone
RIVAL_SUPPORT = 0.3  # from which a pose counts as a rival: by itself it may be right
MARGIN = (-3.0, 6.0)  # of the margins over rivals: beyond, they say no more; the upper one also where there is no rival
DEVIATIONS = 3.0  # of what the fit has seen: beyond, products of evidence would run away
# From where on a kind of evidence is worth a word; they explain a verdict and do not make it.
CONTRADICTED, ABSENT, STRETCHED, ROUGH, SMALL, FEW, PLAIN = 0.1, 0.02, 0.005, 1.8, 0.2, 12, 20
QUALITY = slice(2, 6)  # of ``Evidence.vector``: what ``Evidence.quality`` gives
# Of ``Evidence.vector``: matches, explained over contradicted and over missing points, explained share, logarithms; the
# stretch, in negative hundredths; ``detail_log``.
VOTES, CONTRADICTION, MISSING, SHARE, STRETCH, DETAIL = 1, 4, 5, 6, 8, 10
TURNED = 5.0  # degrees: rivals turned by less are told by their shift


@dataclass(frozen=True)
class Evidence(Agreement):
    """What speaks for a pose: how the surfaces agree, and how many matches of local features do.

    votes: matches that agree, whether or not the pose came from them. repeats: how much of the scene repeats itself
    elsewhere, see ``hypotheses.rivals``.
    """

    votes: int
    repeats: float = 0.0

    @property
    def merit(self) -> float:
        """Which of two refinements of one pose is the better one."""
        return self.explained - self.contradicted + self.votes

    def quality(self) -> np.ndarray:
        """How well the surfaces fit where they meet, more is better: (4,)."""
        close, along = min(1 / self.offset, AS_GOOD), min(1 / self.turn, AS_GOOD)
        against, missing = ((self.explained + 10) / (n + 10) for n in (self.contradicted, self.missing))
        return np.log(np.clip([close, along, against, missing], 1e-3, 1e3))

    def vector(self) -> np.ndarray:
        """What the logistic model sees, after a 1 for the intercept: of each kind of evidence, more is better."""
        share, points = max(self.explained_share, 1e-2), (self.explained + 10) / 400
        against = -100 * min(self.stretch, MOST_STRETCH)
        votes, share, points = np.log([1 + self.votes, share, points])
        return np.array([1.0, votes, *self.quality(), share, points, against, -self.repeats, detail_log(self.detail)])


def detail_log(detail: float) -> float:
    """Points of detail as evidence: their logarithm, against 200 of them."""
    return float(np.log((detail + 5) / 200))


def sigmoid(logit: np.ndarray) -> np.ndarray:
    """The probability of a logit."""
    return 1 / (1 + np.exp(-np.clip(logit, -SURE_LOGIT, SURE_LOGIT)))


def support(x: np.ndarray, weights: Weights) -> np.ndarray:
    """The probability that poses with evidence x (n, d) are right if they have no rival: (n,)."""
    return sigmoid(x @ weights.support)


def standing(x: np.ndarray, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """What each of several distinct poses of one pair weighs among the others, and how the first of them stands.

    x: (n, d) their evidence. Weights (n,), the best 1 or less; standing (s,): the first one's evidence, its margins
    over the others, its support as a logit.
    """
    supports, fits = support(x, weights), x[:, QUALITY] @ weights.fit
    weigh = supports * np.exp(np.clip(fits - fits.max(), -SURE_LOGIT, 0.0))
    first, *others = np.argsort(-weigh, kind="stable")
    rival = max((fits[i] for i in others if supports[i] >= RIVAL_SUPPORT), default=-np.inf)
    votes = max((x[i, VOTES] for i in others), default=0.0)
    margins = np.clip([fits[first] - rival, x[first, VOTES] - votes], *MARGIN)
    return weigh, np.array([*x[first, 1:], *margins, np.clip(x[first] @ weights.support, -10, 10)])


def products(standings: np.ndarray, weights: Weights) -> np.ndarray:
    """1, standings (n, s) in deviations from the mean, and their products: (n, 1 + s + s (s + 1) / 2)."""
    z = np.clip((standings - weights.mean) / weights.std, -DEVIATIONS, DEVIATIONS)
    i, j = np.triu_indices(z.shape[1])
    return np.column_stack([np.ones(len(z)), z, z[:, i] * z[:, j]])


def confidences(x: np.ndarray, largest: np.ndarray, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """The probability of each of several distinct poses, of which at most one is right; what each weighs among them.

    x: (n, d) their evidence, largest (n,): see ``Agreement``. The first has what the verdict gives it, the others share
    the rest.
    """
    weigh, first = standing(x, weights)
    best = int(weigh.argmax())
    logit = products(first[None], weights) @ weights.verdict
    p = float(sigmoid(logit - np.log(SO_MANY) * rivalled(x, largest, weigh, weights))[0])
    p = min(p, most(x[best]))
    rest = np.delete(weigh, best).sum()
    shares = np.minimum((1 - p) * weigh / max(rest, 1e-300), p * weigh / max(weigh[best], 1e-300))
    shares[best] = p
    return shares, weigh


def among(confidence: float, others: Sequence[float]) -> float:
    """What is left of a pose's confidence beside others of which at most one is right, each found by itself.

    Each weighs its odds against "none of them", as if it were alone.
    """
    own, *more = map(odds, (confidence, *others))
    return own / (1 + own + sum(more))


def pooled(confidences: Sequence[float]) -> float:
    """What several looks at one pair say together of one pose: the probability of their mean log odds.

    Not of their sum: they see the same scans, and are wrong together.
    """
    mean = float(np.prod([odds(p) for p in confidences])) ** (1 / len(confidences))
    return mean / (1 + mean)


def told(confidence: float, x: np.ndarray) -> float:
    """The confidence in a pose with evidence x (d,) that a thing tells from its rivals; see ``distinction``."""
    own = TOLD * odds(confidence)
    return min(own / (1 + own), most(x))


def odds(probability: float) -> float:
    """Of a probability, up to 1e12."""
    return probability / max(1 - probability, 1e-12)


def most(x: np.ndarray) -> float:
    """The confidence that evidence x (d,) allows at most, whatever the weights say."""
    bounds = [
        (-x[STRETCH] > 100 * OTHER_SCALE, IN_OTHER_SCALE),
        (x[CONTRADICTION] < 0, DENIED),
        (x[MISSING] < LACKING_MUCH, IF_LACKING),
        (x[SHARE] < np.log(SCANT), IF_SCANT),
        (x[DETAIL] < detail_log(BARE), IF_BARE),
    ]
    return min([p for holds, p in bounds if holds], default=1.0)


def rivalled(x: np.ndarray, largest: np.ndarray, weigh: np.ndarray, weights: Weights) -> bool:
    """Whether the first of poses has a close rival where no thing stands out that one scan has and the other one lacks.

    Close is what is about as likely by itself and fits nearly as well. x: (n, d) the evidence of distinct poses;
    largest (n,): see ``Agreement``; weigh: (n,) what each weighs among them, see ``standing``.
    """
    best, supports = int(weigh.argmax()), support(x, weights)
    others = (supports >= ABOUT * supports[best]) & (weigh >= NEARLY * weigh[best])
    others[best] = False
    return bool((largest[others] + BY_CHANCE < STANDS_OUT * (largest[best] + BY_CHANCE)).any())


@dataclass
class Candidate:
    """A refined pose between the centred frames, with what speaks for it.

    start: where it came from; errors: mean |r| of the IC solver that led to it. support: see ``support``; weight:
    what it weighs among the others; confidence: that it is right, given these. doubt: what another look has against it.
    """

    T_target_source: np.ndarray
    start: str
    errors: list[float]
    evidence: Evidence
    support: float = 0.0
    weight: float = 0.0
    confidence: float = 0.0
    doubt: str = ""


@dataclass
class Judge:
    """Weighs the poses of one pair against each other.

    candidates: distinct poses, best first. repeats: how much of the scene repeats itself, see ``hypotheses.rivals``.
    rivals_of: the pose whose rivals have been tried last, empty if none. told: whether the best pose has been believed
    for a thing that tells it from its rivals, see ``distinction``.
    """

    pair: Pair
    repeats: float = 0.0
    candidates: list[Candidate] = field(default_factory=list)
    rivals_of: np.ndarray = field(default_factory=lambda: np.empty(0))
    told: bool = False
    weights: Weights = field(init=False)

    def __post_init__(self) -> None:
        self.weights = model(self.pair.options.model).verdict

    def consider(self, T_target_source: np.ndarray, start: str, errors: list[float]) -> None:
        """Gather the evidence at a pose, and weigh all candidates anew."""
        found = agreement(self.pair.s, self.pair.t, T_target_source)
        evidence = Evidence(**asdict(found), votes=self.pair.inlier_count(T_target_source))
        self.take(Candidate(T_target_source, start, errors, evidence))

    def adopt(self, known: Candidate) -> None:
        """Take over a candidate of another look on the same voxels: what its surfaces say stays, matches are others."""
        votes = self.pair.inlier_count(known.T_target_source)
        self.take(replace(known, evidence=replace(known.evidence, votes=votes)))

    def take(self, new: Candidate) -> None:
        """Weigh all candidates anew, with another one; of several at one pose the one of most merit stays."""
        known, others = list[Candidate](), list[Candidate]()
        for c in self.candidates:
            (known if self.pair.same(new.T_target_source, c.T_target_source) else others).append(c)
        if known:  # found again: where it came from first is where it comes from
            new = replace(new, start=known[0].start, errors=known[0].errors or new.errors)
        if all(new.evidence.merit >= c.evidence.merit for c in known):
            self.weigh([new, *others])

    def weigh(self, candidates: list[Candidate]) -> None:
        """Weigh candidates against each other, best first, in a scene that repeats itself as much as is known."""
        seen = [replace(c.evidence, repeats=self.repeats) for c in candidates]
        x, largest = np.array([e.vector() for e in seen]), np.array([e.largest for e in seen])
        weighed = [
            replace(c, evidence=e, support=float(s), weight=float(w), confidence=float(p))
            for c, e, s, w, p in zip(
                candidates, seen, support(x, self.weights), *confidences(x, largest, self.weights)[::-1], strict=True
            )
        ]
        self.candidates = sorted(weighed, key=lambda c: -c.weight)

    def found_repeats(self, repeats: float) -> None:
        """Take into account how much of the scene repeats itself."""
        self.repeats = max(self.repeats, repeats)
        self.weigh(self.candidates)

    def believe(self, confidence: float) -> None:
        """Give the best pose another confidence; the other poses share what is left, as before."""
        best, *others = self.candidates
        left = (1 - confidence) / max(1 - best.confidence, 1e-12)
        shared = [replace(c, confidence=min(left * c.confidence, confidence)) for c in others]
        self.candidates = [replace(best, confidence=confidence), *shared]

    def knows(self, T_target_source: np.ndarray) -> bool:
        """Whether a candidate has that pose and fits as well there: what a refinement has spoilt may be tried again."""
        near = [c.T_target_source for c in self.candidates if self.pair.same(T_target_source, c.T_target_source)]
        return bool(near) and max(map(self.pair.overlap_score, near)) >= self.pair.overlap_score(T_target_source)

    def last_word(self, T_target_source: np.ndarray) -> str:
        """What is known of a pose, for the log."""
        known = [c for c in self.candidates if self.pair.same(T_target_source, c.T_target_source)]
        if not known:
            return "no candidate"
        c, e = known[0], known[0].evidence
        return (
            f"{e.explained} points explained, {e.contradicted} contradicted, offset {e.offset:.2f}, {e.votes} matches, "
            f"support {c.support:.2f}, confidence {c.confidence:.2f}"
        )

    @property
    def best(self) -> Candidate:
        """The candidate that is most likely right."""
        return self.candidates[0]

    def sure(self, confidence: float) -> bool:
        """Whether the best candidate has that confidence."""
        return bool(self.candidates) and self.best.confidence >= confidence


def doubts(pair: Pair, best: Candidate, rivals: Sequence[Candidate]) -> list[str]:
    """Why a pose is not beyond doubt, in words, the weightiest first. rivals: poses that fit about as well."""
    e, said = best.evidence, [best.doubt] if best.doubt else []
    if rivals:
        more = f", and {len(rivals) - 1} more" if len(rivals) > 1 else ""
        said.append(f"fits about as well {in_words(pair, best, rivals[0])}{more}")
    against = e.contradicted / max(e.explained + e.contradicted, 1)
    if against > CONTRADICTED:
        said.append(f"{against:.0%} of what both scans saw contradicts the pose")
    elif e.missing > ABSENT * e.explained:
        said.append(f"{e.missing} points that lie together are in one scan alone")
    if e.stretch > STRETCHED:
        said.append(f"fits better with the source scaled by {e.stretch:.1%}: is one of the two in another scale?")
    if e.offset > ROUGH:
        said.append(f"the surfaces lie {e.offset:.1f} times as far apart as their own roughness explains")
    if e.detail < PLAIN:
        said.append("what both scans share is hardly more than three planes, a corner that fits any other")
    if e.explained_share < SMALL:
        said.append(f"only {e.explained_share:.0%} of the smaller scan lies on the other one")
    if e.votes < FEW:
        said.append(f"only {e.votes} matches of local features agree with it")
    return said


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
