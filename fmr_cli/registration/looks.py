"""Looks at a pair: hypotheses, refined and judged; cheap ones first, dearer ones while no pose is sure."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from fmr_cli.errors import RegistrationError
from fmr_cli.registration import hypotheses, refinement
from fmr_cli.registration.confidence import LIKELY, Judge
from fmr_cli.registration.hypotheses import Hypothesis
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch

REFINED = 8  # hypotheses that are refined and judged, of each look
WORTH = 0.4  # of the best overlap score, that a hypothesis has at least to be refined
SURE = 0.95  # once a pose is that sure, on coarse voxels or on fine ones, no more is looked at
FIRST = (1.5, 250)  # a first look: the voxel edge, times the one that suits, and keypoints; it is often sure already
# The looks after it, while none is sure; the coarsest for LiDAR scans far apart in a street, whose rings lie far apart.
FURTHER = ((1.0, 1000), (1.4, 1000), (0.7, 1000), (2.8, 1000))
COARSE = 2.0  # from which a look's poses are too rough to be refined on the voxels that they are judged on
ALIKE = 1.15  # ratio of the clouds' sizes along their axes, up to which they may overlap fully

log = logging.getLogger(__name__)


def at_once(source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch) -> Judge:
    """Looks at all of the target, dearer ones while none is sure."""
    if isinstance(options.init, str) and options.init == "auto" and options.voxel_size is None:
        with suppress(RegistrationError):  # too few voxels of that size
            judge = Judge(make_pair(source, target, options, threads, *FIRST))
            consider(judge, features(judge.pair, time), time)
            if judge.sure(SURE):
                return judge
    return further(source, target, options, threads, time)


def further(
    source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch, enough: float = SURE
) -> Judge:
    """What fine voxels, more places and other scales find, until a pose has ``enough`` confidence."""
    judge = Judge(make_pair(source, target, options, threads, *FURTHER[0]))
    pair = judge.pair
    if not isinstance(options.init, str) or options.init in ("identity", "centroid"):
        return from_given(judge, options.init, time)
    if options.init != "search":
        for coarseness, keypoints in FURTHER:
            with suppress(RegistrationError):
                seen = pair if coarseness == 1.0 else make_pair(source, target, options, threads, coarseness, keypoints)
                found = features(seen, time)
                if coarseness >= COARSE:
                    with time.stage("refine"):
                        found = [replace(h, T_target_source=refinement.refined(seen, h)) for h in found]
                consider(judge, found, time)
            if judge.sure(enough):
                return judge
    if options.init == "search" or (options.init == "auto" and not likely(judge) and may_overlap_fully(pair)):
        with time.stage("search"):
            found = hypotheses.from_search(pair)
        consider(judge, found, time)
    if not judge.candidates:  # every pose found lies beyond the options' max_angle or max_shift
        judge.consider(pair.enter_centred(np.eye(4)), "identity", [])
    return judge


def from_given(judge: Judge, init: Any, time: Stopwatch) -> Judge:
    """A pose that is given; where that does not fit, also where patches and the paper's solver go from it."""
    pair, name = judge.pair, init if isinstance(init, str) else "given"
    T = np.eye(4) if isinstance(init, str) else np.asarray(init, float)
    T = T if name == "centroid" else pair.enter_centred(T)  # the centred identity brings centroid onto centroid
    consider(judge, hypotheses.from_pose(pair, T, name), time)
    if not judge.sure(SURE):
        with time.stage("solve"):
            patches = refinement.by_patches(pair, pair.motion.exact(T), refinement.LEVELS)
            solved = hypotheses.from_solver(pair, T, name)
        consider(judge, [*hypotheses.from_pose(pair, patches, name), *solved], time)
        judge.candidates = [c if c.errors else replace(c, errors=solved[0].errors) for c in judge.candidates]
    if not judge.candidates:
        judge.consider(T, name, [])
    return judge


def features(pair: Pair, time: Stopwatch) -> list[Hypothesis]:
    """Hypotheses from the local features of a pair."""
    with time.stage("describe"):
        pair.describe()
    with time.stage("features"):
        return hypotheses.from_features(pair)


def consider(judge: Judge, found: list[Hypothesis], time: Stopwatch, known: float = 0.0) -> None:
    """Refine and judge the hypotheses that are worth it, best first, and the rivals of what then is likely.

    known: the overlap score of a pose that is known already, if any: what has little beside it is not worth it.
    """
    pair = judge.pair
    with time.stage("refine"):
        ranked = sorted((h for h in found if pair.allowed(h.T_target_source)), key=lambda h: -h.score)
        for hypothesis in ranked[:REFINED]:
            worth = WORTH * max(ranked[0].score, known)
            if hypothesis.score >= worth and not judge.knows(hypothesis.T_target_source):
                judge_refined(judge, hypothesis)
    with time.stage("rivals"):
        # What is not likely has no need of rivals; those of a pose that a former look has found are known.
        if likely(judge) and not np.array_equal(judge.rivals_of, judge.best.T_target_source):
            judge.rivals_of = judge.best.T_target_source
            rivals, repeats = hypotheses.rivals(pair, judge.best.T_target_source)
            judge.found_repeats(repeats)
            for hypothesis in rivals:
                if not judge.knows(hypothesis.T_target_source):
                    judge_refined(judge, hypothesis)


def judge_refined(judge: Judge, hypothesis: Hypothesis) -> None:
    """Judge the pose that a hypothesis leads to, if the options allow it."""
    T = refinement.refined(judge.pair, hypothesis)
    if judge.pair.allowed(T):
        judge.consider(T, hypothesis.start, hypothesis.errors)
        log.info("%s, overlap score %.2f: %s", hypothesis.start, hypothesis.score, judge.last_word(T))


def likely(judge: Judge) -> bool:
    """Whether the best pose would be called right if it were alone."""
    return bool(judge.candidates) and judge.best.support >= LIKELY


def may_overlap_fully(pair: Pair) -> bool:
    """Whether the clouds are of one size along each of their principal axes."""
    s, t = (
        np.linalg.svd(x.points - x.points.mean(0), compute_uv=False) / np.sqrt(len(x.points)) for x in (pair.s, pair.t)
    )
    return bool((np.maximum(s, t) <= ALIKE * np.minimum(s, t) + pair.edge).all())
