"""Looks at a pair: hypotheses, refined and judged; cheap ones first, dearer ones while no pose is sure."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from fmr_cli.errors import RegistrationError
from fmr_cli.registration import hypotheses, refinement
from fmr_cli.registration.confidence import LIKELY, Judge, in_words, pooled, told
from fmr_cli.registration.distinction import stands_out
from fmr_cli.registration.hypotheses import Hypothesis
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch

REFINED = 8  # hypotheses that are refined, of each look
WORTH = 0.4  # of the best overlap score, that a hypothesis has at least to be refined, and a rough pose to be judged
AGAIN = 4  # poses of a look, the best ones, that the next one judges on its own voxels
# A look: the voxel edge, times the one that suits, and keypoints. The first one is often sure already; the second one
# has its voxels and what is described on them, and is most often sure of what the first one is not. The third one sees
# what LiDAR scans share far from both sensors, where points lie so far apart that finer voxels hold no surface. The
# last one sees what tells places that look alike from each other. (What 0.7 times the voxel shows besides changed none
# of the counts of right and ``aligned`` pairs of little overlap by more than one: of the dragon, a kitchen, a LiDAR,
# made-up streets, buildings and objects; by a script that is not in the project.)
Look = tuple[float, int]
FIRST, CLOSER, WIDER, FINE = (1.5, 250), (1.5, 1000), (2.8, 1000), (1.0, 1000)
SURE = 0.95  # once a pose is that sure, no more is looked at
# The same on wide voxels, which don't tell bays of a rack or rows of seats from each other.
SURE_WIDE = 0.97
COARSE = {FIRST: SURE, CLOSER: SURE, WIDER: SURE_WIDE}
# What is left of the confidence in a pose that coarse voxels are surer of than fine ones: of 284 such poses of 1,400
# made-up pairs 0.22 were right, and the only ones, half of their mean confidence (a script that is not in the project).
DISPUTED = 0.5
# Confidence below which the best of coarse looks is as good as nothing, and a fine look not worth its time: by it 3 of
# 205 such pairs were aligned, and rightly.
HOPELESS = 0.05
# Voxels. Where a scan has more, the search has found nothing that local features had not (a script that is not in the
# project: 212 riddles of ``verdict_pairs``, 480 rooms and objects of 60 to 6,000 points).
FEW = 500
ALIKE = 1.15  # ratio of the clouds' sizes along their axes, up to which they may overlap fully

log = logging.getLogger(__name__)


def at_once(
    source: Prepared,
    target: Prepared,
    options: Options,
    threads: int,
    time: Stopwatch,
    first: Judge | None = None,
) -> Judge:
    """Looks at all of the target, dearer ones while none is sure. first: what FIRST has found already.

    Where none is sure and the pair is not hopeless, the last one has the last word on what is ``aligned``, unless a
    close one is surer of the same pose: then both have it. Else the pose is that of the look that is surer then.
    """
    judges, looks = {FIRST: first} if first else {}, list[Look]()
    if isinstance(options.init, str) and options.init == "auto":
        looks = [WIDER] if options.voxel_size else [FIRST, CLOSER, WIDER][len(judges) :]
    for look in looks:
        with suppress(RegistrationError):  # too few voxels of that size
            judges[look] = next_look(look, make_pair(source, target, options, threads, *look), time, judges)
            if judges[look].sure(COARSE[look]):
                return finer(judges[look])
    coarse = surest(judges.values())
    if coarse and not coarse.sure(HOPELESS) and not few(next(iter(judges.values())).pair):
        return finer(coarse)
    fine = further(source, target, options, threads, time, former=coarse)
    close = surest(judge for look, judge in judges.items() if look != WIDER)
    if close and same_best(close, fine):
        return fine if fine.sure(close.best.confidence) else together(close, fine)
    if not coarse or fine.sure(DISPUTED * coarse.best.confidence):
        return fine
    return disputed(finer(coarse), fine)


def next_look(look: Look, pair: Pair, time: Stopwatch, judges: Mapping[Look, Judge]) -> Judge:
    """A coarse look at a pair, made for it, that goes on from those before it."""
    judge = coarse_look(pair, time, taken_up(look, judges))
    if look != WIDER:  # on which things stand out that are none
        tell_apart(judge, time)
    return judge


def surest(judges: Iterable[Judge]) -> Judge | None:
    """The look that is surest of its best pose: the next one goes on from its poses. None where none has any."""
    return max((j for j in judges if j.candidates), key=lambda j: j.best.confidence, default=None)


def taken_up(look: Look, judges: Mapping[Look, Judge]) -> Judge | None:
    """Whose poses a coarse look goes on from: the surest look's before it; on WIDER voxels not if they have no hope.

    There they would have to be refined anew, which those are not worth.
    """
    return surest(judge for judge in judges.values() if look != WIDER or judge.sure(HOPELESS))


def same_best(coarse: Judge, fine: Judge) -> bool:
    """Whether two looks have the same best pose."""
    return coarse.pair.same(coarse.best.T_target_source, fine.best.T_target_source)


def together(close: Judge, fine: Judge) -> Judge:
    """The fine look, with what both looks say of its best pose.

    Fine voxels see more, and yet of poses that they were less sure of than close ones, more were right than they say:
    of 1,400 made-up pairs, each judged by weights that were fitted on others, 749 were ``aligned`` in place of 740, 22
    in place of 20 of them wrongly, and the calibration error was 0.019 in place of 0.026 (a script that is not in the
    project).
    """
    fine.believe(pooled([close.best.confidence, fine.best.confidence]))
    return fine


def disputed(coarse: Judge, fine: Judge) -> Judge:
    """The coarse look, with what DISPUTED leaves of its confidence; the best pose has what the fine look says of it."""
    best, *others = (replace(c, confidence=DISPUTED * c.confidence) for c in coarse.candidates)
    same = same_best(coarse, fine)
    says = "less speaks for it" if same else f"the scans fit better {in_words(coarse.pair, best, fine.best)}"
    return replace(coarse, candidates=[replace(best, doubt=f"on finer voxels {says}"), *others])


def finer(judge: Judge) -> Judge:
    """The look; one on wide voxels with its pair on CLOSER's: its own are too large to refine and describe poses."""
    pair = judge.pair
    closer = make_pair(pair.source, pair.target, pair.options, pair.threads, *CLOSER)
    return replace(judge, pair=closer) if pair.edge > closer.edge else judge


def coarse_look(pair: Pair, time: Stopwatch, former: Judge | None = None, known: float = 0.0) -> Judge:
    """What is found on a pair's voxels, and what is left there of the poses that a former look has found.

    known: see ``consider``.
    """
    judge, found = Judge(pair), features(pair, time)
    look_again(judge, former, time)
    consider(judge, found, time, known)
    return judge


def look_again(judge: Judge, former: Judge | None, time: Stopwatch) -> None:
    """Judge the best poses that a former look has found: refined anew, unless it was on the same voxels."""
    known = former.candidates[:AGAIN] if former else []
    if known:
        with time.stage("describe"):
            judge.pair.describe()
    with time.stage("refine"):
        if former and former.pair.edge == judge.pair.edge:
            for c in known:
                judge.adopt(c)
        else:
            again = [h for c in known for h in hypotheses.from_pose(judge.pair, c.T_target_source, c.start)]
            judge_refined(judge, again)


def further(
    source: Prepared,
    target: Prepared,
    options: Options,
    threads: int,
    time: Stopwatch,
    former: Judge | None = None,
) -> Judge:
    """What fine voxels find, or the options' own start. former: what a look on coarse voxels has found."""
    judge = Judge(make_pair(source, target, options, threads, *FINE))
    pair = judge.pair
    if not isinstance(options.init, str) or options.init in ("identity", "centroid"):
        return from_given(judge, options.init, time)
    look_again(judge, former, time)
    if options.init != "search":
        consider(judge, features(pair, time), time)
    if options.init == "search" or (options.init == "auto" and not likely(judge) and may_need_search(pair)):
        with time.stage("search"):
            found = hypotheses.from_search(pair)
        consider(judge, found, time)
    if not judge.candidates:  # every pose found lies beyond the options' max_angle or max_shift
        judge.consider(pair.enter_centred(np.eye(4)), "identity", [])
    tell_apart(judge, time)
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

    known: the overlap score of a pose that is known otherwise, if any: what has little beside it is not judged.
    """
    pair = judge.pair
    with time.stage("refine"):
        ranked = sorted((h for h in found if pair.allowed(h.T_target_source)), key=lambda h: -h.score)
        rough = refinement.roughly(pair, [h for h in ranked[:REFINED] if h.score >= WORTH * ranked[0].score])
        best = max((h.score for h in rough), default=0.0)
        worth = [h for h in rough if h.score >= WORTH * max(best, known)]
        judge_refined(judge, sorted(worth, key=lambda h: -h.score))
    with time.stage("rivals"):
        # What is not likely has no need of rivals; those of a pose that a former look has found are known.
        if likely(judge) and not np.array_equal(judge.rivals_of, judge.best.T_target_source):
            judge.rivals_of = judge.best.T_target_source
            rivals, repeats = hypotheses.rivals(pair, judge.best.T_target_source)
            judge.found_repeats(repeats)
            judge_refined(judge, rivals)  # as they are: rough steps might take them back to the pose itself


def tell_apart(judge: Judge, time: Stopwatch) -> None:
    """Believe more in a pose that is not sure for its rivals, where one thing tells it from them."""
    if likely(judge) and not judge.sure(SURE):
        with time.stage("rivals"):
            judge.told = stands_out(judge)
            if judge.told:
                judge.believe(told(judge.best.confidence, judge.best.evidence.vector()))


def judge_refined(judge: Judge, found: list[Hypothesis]) -> None:
    """Judge the poses that hypotheses lead to, in their order: those that the options allow and that are not known."""
    new = [h for h in found if not judge.knows(h.T_target_source)]
    for hypothesis, T in zip(new, refinement.refined(judge.pair, new), strict=True):
        if not judge.pair.allowed(T) or judge.knows(hypothesis.T_target_source) or judge.knows(T):
            continue
        judge.consider(T, hypothesis.start, hypothesis.errors)
        log.info("%s, overlap score %.2f: %s", hypothesis.start, hypothesis.score, judge.last_word(T))


def likely(judge: Judge) -> bool:
    """Whether the best pose would be called right if it were alone."""
    return bool(judge.candidates) and judge.best.support >= LIKELY


def may_need_search(pair: Pair) -> bool:
    """Whether few voxels hold points, so that local features say little, and the clouds may overlap fully."""
    return few(pair) and may_overlap_fully(pair)


def few(pair: Pair) -> bool:
    """Whether one of the scans has few voxels."""
    return min(len(pair.s.points), len(pair.t.points)) < FEW


def may_overlap_fully(pair: Pair) -> bool:
    """Whether the clouds are of one size along each of their principal axes."""
    s, t = (
        np.linalg.svd(x.points - x.points.mean(0), compute_uv=False) / np.sqrt(len(x.points)) for x in (pair.s, pair.t)
    )
    return bool((np.maximum(s, t) <= ALIKE * np.minimum(s, t) + pair.edge).all())
