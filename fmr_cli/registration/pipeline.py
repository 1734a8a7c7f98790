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

import numpy as np
from threadpoolctl import ThreadpoolController

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import RegistrationError
from fmr_cli.registration import hypotheses, refinement
from fmr_cli.registration.confidence import Judge
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Registration, Stopwatch, describe

REFINED = 3  # hypotheses that are refined, of each kind of start
SURE = 0.95  # once a pose is that sure on coarse voxels, fine ones are not looked at
SETTLED = 0.8  # once a pose is that sure, no other kind of start is tried, and of its own kind only ...
RIVAL = 0.8  # ... those whose overlap score is nearly as high
COARSENESS, COARSE_KEYPOINTS = 1.5, 250  # a first look on larger voxels, at fewer places, which is often sure already
SCALES = (1.0, 0.8, 1.25)  # tried about the ratio of the clouds' sizes

log = logging.getLogger(__name__)


def prepare(cloud: PointCloud, seed: int = 0) -> Prepared:
    """Check a cloud and make it ready. Raises RegistrationError: fewer than 10 distinct points, all in one place."""
    return Prepared(cloud, seed)


def align(
    source: PointCloud | Prepared, target: PointCloud | Prepared, options: Options = Options(), threads: int = 2
) -> Registration:
    """Register source onto target: find T_target_source with x_target = R x_source + t.

    threads: 2 for what concerns one cloud alone to be done for both side by side, 1 where pairs run side by side
    already. The answer is the same bit for bit, whatever their number and the machine's. Raises RegistrationError
    where a cloud cannot be registered at all, ModelError for the model or the device, FmrError for options that
    contradict each other.
    """
    time = Stopwatch()
    with one_blas_thread():
        with time.stage("prepare"), ThreadPoolExecutor(threads) as pool:
            source, target = pool.map(
                lambda x: x if isinstance(x, Prepared) else prepare(x, options.seed), (source, target)
            )
        verdicts = [
            (factor, look(source if factor == 1.0 else source.scaled(factor), target, given, threads, time))
            for factor, given in scales(source, target, options)
        ]
        factor, judge = max(verdicts, key=lambda verdict: verdict[1].best.confidence)
        best = judge.best
        if options.refine and not options.scale:
            with time.stage("polish"):
                best = replace(best, T_target_source=refinement.exact(judge.pair, best.T_target_source))
        with time.stage("verdict"):
            found = describe(judge.pair, best, judge.candidates[1:], source, factor, options)
    found.seconds = time.seconds
    return found


def look(source: Prepared, target: Prepared, options: Options, threads: int, time: Stopwatch) -> Judge:
    """The poses that were found, weighed against each other: on coarse voxels where that leaves no doubt."""
    if isinstance(options.init, str) and options.init == "auto" and options.voxel_size is None and not options.scale:
        with suppress(RegistrationError):  # too few voxels of that size
            pair = make_pair(source, target, options, threads, coarseness=COARSENESS, keypoints=COARSE_KEYPOINTS)
            judge = find(pair, replace(options, init="features"), time, at_most=1)
            if judge.sure(SURE):
                return judge
    return find(make_pair(source, target, options, threads), options, time)


def find(pair: Pair, options: Options, time: Stopwatch, at_most: int = REFINED) -> Judge:
    """Hypotheses from the starts that the options name, refined and judged; "auto" goes on while none is settled."""
    judge = Judge(pair)
    with time.stage("describe"):
        pair.describe()
    with time.stage("features"):
        features = hypotheses.from_features(pair)
        judge.rivals = [(h.T_target_source, h.score) for h in [*features, *hypotheses.by_chance(pair)]]
    for start, make in hypotheses.makers(pair, options.init, features):
        with time.stage(start):
            ranked = sorted((h for h in make() if pair.allowed(h.T_target_source)), key=lambda h: -h.score)
        with time.stage("refine"):
            for rank, hypothesis in enumerate(ranked):
                if (rank >= at_most or judge.sure(SETTLED)) and hypothesis.score < RIVAL * ranked[0].score:
                    break
                T = refinement.refined(pair, hypothesis)
                if pair.allowed(T):
                    judge.consider(T, hypothesis.start, hypothesis.errors)
        if judge.sure(SETTLED):
            break
    if not judge.candidates:  # every pose found lies beyond the options' max_angle or max_shift
        judge.consider(pair.enter_centred(np.eye(4)), "identity", [])
    return judge


def scales(source: Prepared, target: Prepared, options: Options) -> Iterator[tuple[float, Options]]:
    """What to multiply the source by, with the options for it: a given pose's own scale, or some about the clouds'."""
    if not options.scale:
        yield 1.0, options
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
