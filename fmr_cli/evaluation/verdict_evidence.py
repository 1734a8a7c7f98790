"""The evidence at right and wrong poses of made-up scans: what the verdict's weights are fitted on.

Every pose that ``align`` would judge counts, so that the wrong ones are the plausible ones.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.cores import usable_cores
from fmr_cli.errors import RegistrationError
from fmr_cli.registration.confidence import Judge, pooled
from fmr_cli.registration.looks import COARSE, DISPUTED, FINE, HOPELESS, WIDER, Look, further, next_look, surest
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.pipeline import one_blas_thread
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch
from fmr_cli.synthetic.calibration_pairs import calibration_pair
from fmr_cli.synthetic.verdict_pairs import FAMILIES

RIGHT_DEGREES, RIGHT_SHARE = 15.0, 0.03  # what counts as right: the field's usual angle, and a share of the size
CHUNK = 2  # pairs handed to a worker at a time: a pair takes a second, a hand-over a millisecond


@dataclass(frozen=True)
class Judged:
    """What one look at a pair found. x: (n, 11), ``Evidence.vector`` of each pose; right: (n,) bool.

    largest: (n,), ``Agreement.largest`` of each; place: (n,), a number for each pose, one for what several looks found;
    told: (n,) bool, the one that a thing tells from its rivals, if any, see ``distinction``; look: which one, see
    ``looks``; kind, unique: of the pair, see ``verdict_pairs``; number: which pair.
    """

    x: np.ndarray
    right: np.ndarray
    largest: np.ndarray
    place: np.ndarray
    told: np.ndarray
    look: Look
    kind: str
    unique: bool
    number: int


def gather(pairs: int, seed: int, workers: int | None = None) -> list[Judged]:
    """The evidence of ``pairs`` fresh pairs, four looks each, the same whatever the number of workers."""
    with ProcessPoolExecutor(workers or usable_cores(), mp_context=multiprocessing.get_context("spawn")) as pool:
        found = pool.map(pair_evidence, [(seed, number) for number in range(pairs)], chunksize=CHUNK)
        return [judged for looks in found for judged in looks]


def pair_evidence(seed: tuple[int, int]) -> list[Judged]:
    """What each look finds at the pair ``seed`` = (run, number).

    Of degenerate pairs no pose is right and all fit: they are told by what is not determined, and give no evidence.
    """
    pair = calibration_pair(*seed)
    if pair.kind in FAMILIES["degenerate"]:
        return []
    truth = pair.poses[:1]  # the pose at which the scans were taken: its aliases are no righter than chance
    found, places = list[Judged](), list[np.ndarray]()
    try:
        with one_blas_thread():
            source, target = Prepared(PointCloud(pair.source)), Prepared(PointCloud(pair.target))
            for look, judge in all_looks(source, target).items():
                poses = [judge.pair.leave_centred(c.T_target_source) for c in judge.candidates]
                right = [bool(truth) and pair.of(truth).is_right(T, RIGHT_DEGREES, RIGHT_SHARE) for T in poses]
                x = np.array([c.evidence.vector() for c in judge.candidates])
                if len(x):
                    largest = np.array([c.evidence.largest for c in judge.candidates])
                    place = np.array([number_of(c.T_target_source, places, judge.pair) for c in judge.candidates])
                    told = judge.told & (np.arange(len(x)) == 0)
                    found.append(
                        Judged(x, np.array(right), largest, place, told, look, pair.kind, pair.unique, seed[1])
                    )
    except RegistrationError:  # a street and a teacup: nothing to judge
        return []
    return found


def number_of(T_target_source: np.ndarray, places: list[np.ndarray], pair: Pair) -> int:
    """Which of the places a pose is; one that is none of them is added."""
    for number, place in enumerate(places):
        if pair.same(T_target_source, place):
            return number
    places.append(T_target_source)
    return len(places) - 1


def all_looks(source: Prepared, target: Prepared) -> dict[Look, Judge]:
    """What ``align`` would judge at each look, had none of those before been enough."""
    time, judges = Stopwatch(), dict[Look, Judge]()
    for look in COARSE:
        with suppress(RegistrationError):  # too few voxels of that size
            judges[look] = next_look(look, make_pair(source, target, Options(), 1, *look), time, judges)
    return judges | {FINE: further(source, target, Options(), 1, time, surest(judges.values()))}


def decisive(said: Mapping[Look, float], place: Mapping[Look, int]) -> tuple[Look, float]:
    """Where ``align`` ends (``looks.at_once``): at which look, with which confidence.

    said: of each look the confidence in its best pose; place: which one that is.
    """
    coarse = [look for look in COARSE if look in said]
    for look in coarse:
        if said[look] >= COARSE[look]:
            return look, said[look]
    best = max(coarse, key=lambda look: said[look], default=FINE)
    if said[best] < HOPELESS:
        return best, said[best]
    close = max((look for look in coarse if look != WIDER), key=lambda look: said[look], default=FINE)
    if FINE in said and place[close] == place[FINE]:
        return FINE, max(said[FINE], pooled([said[close], said[FINE]]))
    if FINE in said and said[FINE] >= DISPUTED * said[best]:
        return FINE, said[FINE]
    return best, DISPUTED * said[best]
