"""A scan in a map: where the target reaches much further than the source, its parts are looked at one by one.

Whole, so large a target would be seen on voxels too coarse for the scan, by too few keypoints for any one place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import product

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.sampling import WITHIN
from fmr_cli.registration.confidence import ALIGNED, Judge, among
from fmr_cli.registration.hypotheses import Hypothesis
from fmr_cli.registration.looks import FIRST, SURE, consider, features, further
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import MIN_POINTS, Prepared
from fmr_cli.registration.result import Stopwatch

FROM = 2.5  # times the source's reach, from which the target is taken for a map: below, one look at all of it is enough
WIDTH, STEP = 3.0, 1.5  # of a part, and from one to the next, in reaches: some part holds nearly all that a scan saw
MOST_PARTS = 400  # a reach that gives more is hardly that of a scan in a map: a tea cup and a street
FEWEST = 20 * MIN_POINTS  # points of a part that is worth a look
PLACES, APART = 4, 10.0  # whose poses are judged, and voxel edges that they lie apart
CLOSER = 2  # of them that are looked at closer, the second one where the first one was not the place


def is_map(source: Prepared, target: Prepared, options: Options) -> bool:
    """Whether the place of the source in the target is to be sought part by part."""
    asked = isinstance(options.init, str) and options.init in ("auto", "features")
    return asked and not options.scale and options.voxel_size is None and target.reach > FROM * source.reach


def parts(source: Prepared, target: Prepared, options: Options) -> Iterator[Prepared]:
    """The target's parts in which the source may lie, of WIDTH reaches; none at all if they were too many.

    With ``options.max_shift``, those alone that it allows.
    """
    size = source.reach
    low, high = np.quantile(target.points, [1 - WITHIN, WITHIN], axis=0)
    steps = [max(math.ceil((b - a) / (STEP * size)), 1) for a, b in zip(low, high, strict=True)]
    if math.prod(steps) > MOST_PARTS:
        return
    for step in product(*(range(n) for n in steps)):
        centre = low + (high - low) * (np.array(step) + 0.5) / steps
        away = np.linalg.norm(np.maximum(np.abs(centre + target.centre - source.centre) - WIDTH / 2 * size, 0))
        if options.max_shift is not None and away > options.max_shift:
            continue
        inside = (np.abs(target.points - centre) <= WIDTH / 2 * size).all(1)
        if inside.sum() >= FEWEST:
            yield target.part(inside)


def look(source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch) -> Judge | None:
    """What is found in the parts of a map where a glance finds most; None where it has no such parts.

    The poses of different places exclude each other: the best one shares its confidence with what else looks right.
    """
    glances: list[tuple[Pair, list[Hypothesis]]] = []
    for part in parts(source, target, options):
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
    confidence = among(best.confidence, [c.confidence for c in elsewhere])
    judge.candidates = [replace(best, confidence=confidence), *elsewhere, *judge.candidates[1:]]
    return judge
