"""The way of one pair: two clouds in, a ``Registration`` out.

prepare (voxel grid, centred coordinates) -> hypotheses -> refine -> judge -> select -> exact -> describe
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.registration import hypotheses, mirror, places, refinement, sites
from fmr_cli.registration.confidence import LIKELY, Candidate, Judge
from fmr_cli.registration.looks import CLOSER, FIRST, HOPELESS, SURE, at_once, coarse_look, likely
from fmr_cli.registration.models import model
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared, check_systems
from fmr_cli.registration.result import Registration, Stopwatch, describe
from fmr_cli.registration.units import factor_of, unit_hint

CHECKS = 5  # iterations of the IC solver from the pose found, where asked for
SOUGHT = ("features", "search", "rival")  # starts that nobody gave: where the pose is hopeless, a polish mends nothing
SCALES = (1.0, 0.8, 1.25)  # tried about the ratio of the clouds' sizes


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
    fit. Where a pose explains less than half of the smaller scan, that look is part of the verdict: the better fit is
    believed.
    Raises RegistrationError where a cloud cannot be registered at all, ModelError for the model or the device, FmrError
    for options that contradict each other.
    """
    time = Stopwatch()
    with one_blas_thread(), time.stage("prepare"), ThreadPoolExecutor(threads) as pool:
        prepared, target = pool.map(
            lambda x: x if isinstance(x, Prepared) else prepare(x, options.seed), (source, target)
        )
    check_systems(prepared, target)
    found = as_they_are(prepared, target, options, threads, check, time)
    aligned = found.status == "aligned"
    if aligned and mirror.unlikely(found):
        return found
    if known := by_way_of_a_site(prepared, target, options, time):
        believed = sites.believed(prepared, found, known)
        return replace(believed, warnings=found.warnings, seconds=time.seconds)
    fits = None
    if aligned or (hints and not options.allow_mirror):
        fits = mirror_look(prepared, target, options, threads, found if aligned else None)
    if aligned:
        found = mirror.weighed(found, fits)
    if found.status == "aligned":
        return found
    if options.allow_mirror:
        image = prepared.mirrored()
        other = as_they_are(image, target, options, threads, check, Stopwatch())
        return mirror.undone(other, image.centre) if other.status == "aligned" else found
    if fits and hints:
        found.warnings.append(mirror.HINT.format(fits.confidence))
    return found


def by_way_of_a_site(source: Prepared, target: Prepared, options: Options, time: Stopwatch) -> Registration | None:
    """The pose of two scans of a site that the model knows, if both are found there; see ``sites``."""
    if not sites.asked(options):
        return None
    with one_blas_thread(), time.stage("site"):
        source_there = sites.likeliest(on_sites(source, options))
        target_there = sites.likeliest(on_sites(target, options)) if source_there else None
        if not (source_there and target_there):
            return None
        return sites.composed(source, target, options, source_there, target_there)


def on_sites(scan: Prepared, options: Options) -> list[sites.Placement]:
    """Where a scan is found on each site that the model knows; sought once for all pairs that the scan is in."""
    found = []
    for site in model(options.model).sites:
        found += scan.on_sites.get(site, partial(on_site, scan, site, options))
    return found


def on_site(scan: Prepared, site: Prepared, options: Options) -> list[sites.Placement]:
    """Where a scan is found on a site; nowhere if it cannot be registered with that."""
    with suppress(RegistrationError):  # too small beside the site, say
        given = sites.there(options)
        found = as_they_are(scan, site, given, 1, False, Stopwatch())
        if found.status == "aligned" and not mirror.unlikely(found):
            found = mirror.weighed(found, mirror_look(scan, site, given, 1, found))
        return [sites.Placement(site, found)]
    return []


def mirror_look(
    source: Prepared, target: Prepared, options: Options, threads: int = 1, beside: Registration | None = None
) -> Candidate | None:
    """How the mirror image of the source fits the target, where a quick look is sure that it does.

    Closer only where a first look makes it likely: most pairs fit in no way but one, and a closer look is several times
    as dear. beside: a pose of the source as it is that is ``aligned``; what hardly overlaps beside it is not judged.
    """
    time = Stopwatch()
    with one_blas_thread(), suppress(RegistrationError):
        image = source.mirrored()
        for detail in FIRST, CLOSER:
            known = 0.0
            if beside:
                pair = make_pair(source, target, options, threads, *detail)
                known = pair.overlap_score(pair.enter_centred(beside.T_target_source))
            judge = coarse_look(make_pair(image, target, options, threads, *detail), time, known=known)
            if judge.sure(SURE):
                return judge.best
            if not likely(judge):
                return None
    return None


def as_they_are(
    source: Prepared, target: Prepared, options: Options, threads: int, check: bool, time: Stopwatch
) -> Registration:
    """``align`` without a mirror."""
    with one_blas_thread():
        verdicts: list[tuple[float, Judge]] = []
        for factor, given in scales(source, target, options):
            scaled = source if factor == 1.0 else source.scaled(factor)
            verdicts.append((factor, look(scaled, target, given, threads, time)))
            if verdicts[-1][1].sure(SURE):
                break
        factor, judge = max(verdicts, key=lambda verdict: verdict[1].best.confidence)
        best = judge.best
        polished = refinement.Polished(best.T_target_source)
        if options.refine and (judge.sure(HOPELESS) or best.start not in SOUGHT):
            with time.stage("polish"):
                polished = refinement.exact(judge.pair, refinement.by_geometry(judge.pair, best.T_target_source))
                best = replace(best, T_target_source=polished.T_target_source)
        with time.stage("verdict"):
            found = describe(judge.pair, best, judge.candidates[1:], source, factor, options, polished.observed())
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
    judge = places.look(source, target, options, threads, time) if places.is_map(source, target, options) else None
    if judge and judge.sure(LIKELY):
        return judge
    whole = at_once(source, target, options, threads, time)
    return judge if judge and judge.sure(whole.best.confidence) else whole


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
