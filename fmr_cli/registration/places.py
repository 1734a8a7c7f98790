"""A scan in a map: where the target reaches much further than the source, its parts are looked at one by one.

Whole, so large a target would be seen on voxels too coarse for the scan, by too few keypoints for any one place. What
the glance at the parts needs of the map depends on the scan by its voxel edge alone: it is made once for many scans.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import product

import numpy as np

from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.sampling import WITHIN
from fmr_cli.registration.confidence import ALIGNED, Judge, among
from fmr_cli.registration.hypotheses import Hypothesis, from_matches
from fmr_cli.registration.looks import FIRST, SURE, at_once, consider, features
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import MIN_POINTS, SPACINGS, Prepared
from fmr_cli.registration.result import Stopwatch

FROM = 2.5  # times the source's reach, from which the target is taken for a map: below, one look at all of it is enough
WIDTH, STEP = 3.0, 1.5  # of a part, and from one to the next, in reaches: some part holds nearly all that a scan saw
# Voxel edges: of a block, which has as many keypoints as the scan and hardly more surface (a scan's is 47 edges wide;
# LiDAR leaves gaps). Of 130 scans in made-up towns 129 are found so (`benchmarks.places`); with half the keypoints,
# 13 of 16 were.
BLOCK = 64.0
MOST_PARTS = 400  # a reach that gives more is hardly that of a scan in a map: a tea cup and a street
FEWEST = 20 * MIN_POINTS  # points of a part that is worth a look
NOTCH = 1.25  # from one voxel edge that a map is looked at with to the next: scans of one sensor share two or three
PLACES, APART = 4, 10.0  # whose poses are judged, and voxel edges that they lie apart
CLOSER = 2  # of them that are looked at closer, the second one where the first one was not the place


def is_map(source: Prepared, target: Prepared, options: Options) -> bool:
    """Whether the place of the source in the target is to be sought part by part."""
    asked = isinstance(options.init, str) and options.init in ("auto", "features")
    return asked and not options.scale and options.voxel_size is None and target.reach > FROM * source.reach


def notched(length: float, target: Prepared) -> float:
    """The next larger length of a series that depends on the map alone."""
    return float(target.spacing * NOTCH ** math.ceil(math.log(length / target.spacing) / math.log(NOTCH)))


def part_centres(source: Prepared, target: Prepared, options: Options, size: float) -> Iterator[np.ndarray]:
    """The centres (3,) of the target's parts in which the source may lie, of WIDTH sizes; none if they were too many.

    With ``options.max_shift``, those alone that it allows.
    """
    low, high = np.quantile(target.points, [1 - WITHIN, WITHIN], axis=0)
    steps = [max(math.ceil((b - a) / (STEP * size)), 1) for a, b in zip(low, high, strict=True)]
    if math.prod(steps) > MOST_PARTS:
        return
    for step in product(*(range(n) for n in steps)):
        centre = low + (high - low) * (np.array(step) + 0.5) / steps
        away = np.linalg.norm(np.maximum(np.abs(centre + target.centre - source.centre) - WIDTH / 2 * size, 0))
        if options.max_shift is None or away <= options.max_shift:
            yield centre


def within(points: np.ndarray, centre: np.ndarray, size: float) -> np.ndarray:
    """Which of points (N, 3) lie in the part of WIDTH sizes about a centre."""
    return (np.abs(points - centre) <= WIDTH / 2 * size).all(1)


def glance(pair: Pair, centres: list[np.ndarray], size: float) -> list[Hypothesis]:
    """What the local features of the source and of each part about ``centres`` agree on, best first."""
    p, a = pair.described(pair.source)
    q, b = pair.target.described_evenly(pair.edge, pair.keypoints, BLOCK * pair.edge, pair.local, pair.threads)
    similarity = a @ b.T
    found = []
    for centre in centres:
        inside = np.flatnonzero(within(q, centre, size))
        if len(inside) == 0:
            continue
        nearest = q[inside[similarity[:, inside].argmax(1)]]
        found += [h for h in from_matches(pair, p, nearest) if pair.allowed(h.T_target_source)]
    return sorted(found, key=lambda h: -h.score)


def look(source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch) -> Judge | None:
    """What is found in the parts of a map where a glance finds most; None where it has no such parts.

    The poses of different places exclude each other: the best one shares its confidence with what else looks right.
    """
    size = source.reach
    centres, found = list(part_centres(source, target, options, size)), []
    if not centres:
        return None
    edge = FIRST[0] * max(source.edge, SPACINGS * source.spacing, SPACINGS * target.spacing)
    with time.stage("places"), suppress(RegistrationError):  # too few voxels of that size
        seen = Pair(source, target, options, notched(edge, target), FIRST[1], threads)
        found = glance(seen, centres, size)
    looked: list[np.ndarray] = []  # where the source's centre came to lie
    judges: list[Judge] = []
    for hypothesis in found:
        at = hypothesis.T_target_source[:3, 3]
        if len(looked) < PLACES and all(np.linalg.norm(at - other) > APART * seen.edge for other in looked):
            looked.append(at)
            inside = within(target.points, at, size)
            if inside.sum() >= FEWEST:
                with suppress(RegistrationError):
                    judges.append(judged(seen, hypothesis, target.part(inside), time))
    judges = sorted((j for j in judges if j.candidates), key=lambda j: -j.best.confidence)
    for number, judge in enumerate(judges[:CLOSER]):
        if not judge.sure(SURE):
            judges[number] = at_once(source, judge.pair.target, options, threads, time, judge)
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
    confidence = among(best.confidence, [c.confidence for c in elsewhere])
    judge.candidates = [replace(best, confidence=confidence), *elsewhere, *judge.candidates[1:]]
    return judge


def judged(seen: Pair, hypothesis: Hypothesis, part: Prepared, time: Stopwatch) -> Judge:
    """What is found in the part of a map about a place, from the pose there that a glance ``seen`` of the map gave."""
    pair = make_pair(seen.source, part, seen.options, seen.threads, *FIRST)
    T = pair.enter_centred(seen.leave_centred(hypothesis.T_target_source))
    judge = Judge(pair)
    consider(judge, [replace(hypothesis, T_target_source=T, score=pair.overlap_score(T)), *features(pair, time)], time)
    return judge
