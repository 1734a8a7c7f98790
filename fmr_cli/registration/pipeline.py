"""The way of one pair: two clouds in, a ``Registration`` out.

prepare (voxel grid, centred coordinates) -> hypotheses -> refine -> judge -> select -> exact -> describe
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.registration import hypotheses, mirror, places, refinement
from fmr_cli.registration.confidence import ALIGNED, LIKELY, Judge
from fmr_cli.registration.hypotheses import Hypothesis
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared, check_systems
from fmr_cli.registration.result import Registration, Stopwatch, describe
from fmr_cli.registration.units import factor_of, unit_hint

REFINED = 8  # hypotheses that are refined and judged, of each look
WORTH = 0.4  # of the best overlap score, that a hypothesis has at least to be refined
SURE = 0.95  # once a pose is that sure, on coarse voxels or on fine ones, no more is looked at
FIRST = (1.5, 250)  # a first look: the voxel edge, times the one that suits, and keypoints; it is often sure already
PLACES, APART = 4, 10.0  # of a map whose poses are judged, and voxel edges that they lie apart
CLOSER = 2  # of them that are looked at closer, the second one where the first one was not the place
FURTHER = ((1.0, 1000), (1.4, 1000), (0.7, 1000))  # the looks after it, while none is sure
ALIKE = 1.15  # ratio of the clouds' sizes along their axes, up to which they may overlap fully
CHECKS = 5  # iterations of the IC solver from the pose found, where asked for
SCALES = (1.0, 0.8, 1.25)  # tried about the ratio of the clouds' sizes

log = logging.getLogger(__name__)


def prepare(cloud: PointCloud, seed: int = 0) -> Prepared:
    """Check a cloud and make it ready. Raises RegistrationError: fewer than 10 distinct points, all in one place."""
    return Prepared(cloud, seed)


def align(
    source: PointCloud | Prepared,
    target: PointCloud | Prepared,
    options: Options = Options(),
    threads: int = 2,
    check: bool = False,
    hints: bool = True,
) -> Registration:
    """Register source onto target: find T_target_source with x_target = R x_source + t.

    With ``options.allow_mirror`` the mirror image of the source is registered too, unless the source is ``aligned``; R
    then has the determinant -1, and ``mirrored`` says so.

    threads: 2 for what concerns one cloud alone to be done for both side by side, 1 where pairs run side by side
    already. The answer is the same bit for bit, whatever their number and the machine's. check: also let the paper's IC
    solver go on from the pose found, see ``Registration.feature_check``. hints: where the pair is not ``aligned``, also
    take a quick look whether the source's mirror image fits, and warn; False where many pairs are tried that need not
    fit. Raises RegistrationError where a cloud cannot be registered at all, ModelError for the model or the device,
    FmrError for options that contradict each other.
    """
    found = as_they_are(source, target, options, threads, check)
    if found.status == "aligned":
        return found
    if not options.allow_mirror:
        fits = mirror_fits(source, target, options) if hints else None
        found.warnings += [] if fits is None else [mirror.HINT.format(fits)]
        return found
    image = mirror.image(source, options.seed)
    other = as_they_are(image, target, options, threads, check)
    return mirror.undone(other, image.centre) if other.status == "aligned" else found


def mirror_fits(source: PointCloud | Prepared, target: PointCloud | Prepared, options: Options) -> float | None:
    """The confidence that the mirror image of the source fits the target, where a quick look is sure of it."""
    time = Stopwatch()
    with one_blas_thread(), suppress(RegistrationError):
        image = mirror.image(source, options.seed)
        target = target if isinstance(target, Prepared) else prepare(target, options.seed)
        for detail in (FIRST, FURTHER[0]):
            judge = Judge(make_pair(image, target, options, 2, *detail))
            consider(judge, features(judge.pair, time), time)
            if judge.sure(SURE):
                return judge.best.confidence
    return None


def as_they_are(
    source: PointCloud | Prepared, target: PointCloud | Prepared, options: Options, threads: int, check: bool
) -> Registration:
    """``align`` without a mirror."""
    time = Stopwatch()
    with one_blas_thread():
        with time.stage("prepare"), ThreadPoolExecutor(threads) as pool:
            source, target = pool.map(
                lambda x: x if isinstance(x, Prepared) else prepare(x, options.seed), (source, target)
            )
        check_systems(source, target)
        verdicts: list[tuple[float, Judge]] = []
        for factor, given in scales(source, target, options):
            scaled = source if factor == 1.0 else source.scaled(factor)
            verdicts.append((factor, look(scaled, target, given, threads, time)))
            if verdicts[-1][1].sure(SURE):
                break
        factor, judge = max(verdicts, key=lambda verdict: verdict[1].best.confidence)
        best = judge.best
        if options.refine:
            with time.stage("polish"):
                T = refinement.by_geometry(judge.pair, best.T_target_source)
                best = replace(best, T_target_source=refinement.exact(judge.pair, T))
        with time.stage("verdict"):
            found = describe(judge.pair, best, judge.candidates[1:], source, factor, options)
        if check:
            with time.stage("check"):
                found.feature_check = feature_check(judge.pair, best.T_target_source)
    found.warnings += [*source.notes, *target.notes]
    if (
        found.status != "aligned"
        and not (options.scale or options.unit)
        and (hint := unit_hint(source.points, target.points))
    ):
        found.warnings.append(hint)
    found.seconds = time.seconds
    return found


def look(source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch) -> Judge:
    """The poses that were found, weighed against each other: in a map part by part, else in all of the target."""
    judge = in_places(source, target, options, threads, time) if places.is_map(source, target, options) else None
    if judge and judge.sure(LIKELY):
        return judge
    whole = at_once(source, target, options, threads, time)
    return judge if judge and judge.sure(whole.best.confidence) else whole


def in_places(source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch) -> Judge | None:
    """What is found in the parts of a map where a glance finds most; None where it has no such parts.

    The poses of different places exclude each other: the best one shares its confidence with what else looks right.
    """
    glances: list[tuple[Pair, list[Hypothesis]]] = []
    for part in places.parts(source, target, options):
        with suppress(RegistrationError):
            pair = make_pair(source, part, options, threads, *FIRST)
            found = [h for h in features(pair, time) if pair.allowed(h.T_target_source)]
            if found:
                glances.append((pair, sorted(found, key=lambda h: -h.score)))
    looked: list[np.ndarray] = []  # where the source's centre came to lie
    judges: list[Judge] = []
    for pair, found in sorted(glances, key=lambda glance: -glance[1][0].score):
        at = transform_points(pair.leave_centred(found[0].T_target_source), source.centre[None])
        if len(judges) < PLACES and all(np.linalg.norm(at - other) > APART * pair.edge for other in looked):
            looked.append(at)
            judges.append(Judge(pair))
            consider(judges[-1], found, time)
    judges = sorted((j for j in judges if j.candidates), key=lambda j: -j.best.confidence)
    for number, judge in enumerate(judges[:CLOSER]):
        if not judge.sure(SURE):
            judges[number] = further(source, judge.pair.target, options, threads, time)
        if judges[number].sure(ALIGNED):
            break
    if not judges:
        return None
    judge, *others = sorted(judges, key=lambda j: -j.best.confidence)
    pair, best = judge.pair, judge.best
    elsewhere = [
        replace(j.best, T_target_source=pair.enter_centred(j.pair.leave_centred(j.best.T_target_source)))
        for j in others
    ]
    elsewhere = [c for c in elsewhere if not pair.same(c.T_target_source, best.T_target_source)]
    # At most one of them is right, or none: each weighs its odds against "none", as if it were alone.
    odds = [c.confidence / max(1 - c.confidence, 1e-12) for c in (best, *elsewhere)]
    judge.candidates = [replace(best, confidence=odds[0] / (1 + sum(odds))), *elsewhere, *judge.candidates[1:]]
    return judge


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
                consider(judge, features(seen, time), time)
            if judge.sure(enough):
                return judge
    likely = bool(judge.candidates) and judge.best.support >= LIKELY
    if options.init == "search" or (options.init == "auto" and not likely and may_overlap_fully(pair)):
        with time.stage("search"):
            found = hypotheses.from_search(pair)
        consider(judge, found, time)
    if not judge.candidates:  # every pose found lies beyond the options' max_angle or max_shift
        judge.consider(pair.enter_centred(np.eye(4)), "identity", [])
    return judge


def from_given(judge: Judge, init: Any, time: Stopwatch) -> Judge:
    """A pose that is given, as it is; where that does not fit, where the paper's solver goes from it."""
    pair, name = judge.pair, init if isinstance(init, str) else "given"
    T = np.eye(4) if isinstance(init, str) else np.asarray(init, float)
    T = T if name == "centroid" else pair.enter_centred(T)  # the centred identity brings centroid onto centroid
    consider(judge, hypotheses.from_pose(pair, T, name), time)
    if not judge.sure(SURE):
        with time.stage("solve"):
            found = hypotheses.from_solver(pair, T, name)
        consider(judge, found, time)
        judge.candidates = [c if c.errors else replace(c, errors=found[0].errors) for c in judge.candidates]
    if not judge.candidates:
        judge.consider(T, name, [])
    return judge


def features(pair: Pair, time: Stopwatch) -> list[Hypothesis]:
    """Hypotheses from the local features of a pair."""
    with time.stage("describe"):
        pair.describe()
    with time.stage("features"):
        return hypotheses.from_features(pair)


def consider(judge: Judge, found: list[Hypothesis], time: Stopwatch) -> None:
    """Refine and judge the hypotheses that are worth it, best first, and the rivals of what then is likely."""
    pair = judge.pair
    with time.stage("refine"):
        ranked = sorted((h for h in found if pair.allowed(h.T_target_source)), key=lambda h: -h.score)
        for hypothesis in ranked[:REFINED]:
            if hypothesis.score >= WORTH * ranked[0].score and not judge.knows(hypothesis.T_target_source):
                judge_refined(judge, hypothesis)
    with time.stage("rivals"):
        if judge.candidates and judge.best.support >= LIKELY:  # what is not has no need of rivals
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


def feature_check(pair: Pair, T_target_source: np.ndarray) -> dict[str, Any]:
    """Whether the paper's metric agrees with a pose: what a few iterations of its solver from there do."""
    there = hypotheses.from_solver(pair, T_target_source, "check", CHECKS)[0]
    centre = pair.s.points.mean(0)[None]
    shift = transform_points(there.T_target_source, centre) - transform_points(T_target_source, centre)
    return {
        "errors": there.errors,
        "angle": angle_degrees(np.linalg.inv(T_target_source) @ there.T_target_source),
        "shift": float(np.linalg.norm(shift)),
    }


def may_overlap_fully(pair: Pair) -> bool:
    """Whether the clouds are of one size along each of their principal axes."""
    s, t = (
        np.linalg.svd(x.points - x.points.mean(0), compute_uv=False) / np.sqrt(len(x.points)) for x in (pair.s, pair.t)
    )
    return bool((np.maximum(s, t) <= ALIKE * np.minimum(s, t) + pair.edge).all())


def scales(source: Prepared, target: Prepared, options: Options) -> Iterator[tuple[float, Options]]:
    """What to multiply the source by, with the options for it: a given pose's own scale, or some about the clouds'."""
    if not options.scale:
        yield factor_of(options.unit) if options.unit else 1.0, options
    elif not isinstance(options.init, str):
        T = np.array(options.init, float)
        factor = float(np.cbrt(np.linalg.det(T[:3, :3])))
        T[:3, :3] /= factor
        yield factor, replace(options, init=T)
    else:
        sizes = float(np.sqrt((target.points**2).sum(1).mean() / (source.points**2).sum(1).mean()))
        for scale in SCALES:
            yield sizes * scale, options


@cache
def blas() -> ThreadpoolController:
    """The libraries behind numpy's matrix products."""
    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """On blocks as small as ours, further threads of the matrix products only wait."""
    with blas().limit(limits=1):
        yield
