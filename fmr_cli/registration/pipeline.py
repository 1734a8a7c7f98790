"""The pipeline for one pair: two clouds in, a ``Registration`` out.

prepare (voxel grid, local origin) -> start poses -> feature-metric refinement -> geometric polish -> verdict
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import cache

import numpy as np
from threadpoolctl import ThreadpoolController

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.errors import FmrError, RegistrationError
from fmr_cli.geometry import observability
from fmr_cli.geometry.motion import Motion
from fmr_cli.registration import confidence
from fmr_cli.registration.models import bundled_local_encoder, fast_encoder, solver
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import KEYPOINTS, Candidate, Pair, Start
from fmr_cli.registration.prepared import Prepared, pair_edge
from fmr_cli.registration.result import Registration

REFINED = 3  # starts that are refined, of each kind
SURE = 0.95  # once a pose is that sure on coarse voxels, fine ones are not looked at
SETTLED = 0.8  # once a pose is that sure, no other kind of start is tried, and of its own kind only
RIVAL = 0.8  # those that coincide nearly as much
COARSE, COARSE_KEYPOINTS = 1.5, 250  # a first look on larger voxels, at fewer places, which is often sure already
SCALES = (1.0, 0.8, 1.25)  # tried about the ratio of the clouds' sizes


def prepare(cloud: PointCloud, seed: int = 0) -> Prepared:
    """Check a cloud and make it ready. Raises RegistrationError: fewer than 10 distinct points, all in one place."""
    return Prepared(cloud, seed)


@cache
def blas() -> ThreadpoolController:
    """The libraries behind numpy's matrix products: on blocks as small as ours, their threads only wait."""
    return ThreadpoolController()


@contextmanager
def stage(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the wall time of its block to ``seconds[name]``."""
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


def align(
    source: PointCloud | Prepared, target: PointCloud | Prepared, options: Options = Options(), threads: int = 2
) -> Registration:
    """Register source onto target: find T_target_source with x_target = R x_source + t.

    threads: 2 for what concerns one cloud alone to be done for both side by side, 1 where pairs run side by side
    already. The answer is the same bit for bit, whatever their number and the machine's. Raises RegistrationError
    where a cloud cannot be registered at all, ModelError for the model or the device, FmrError for options that
    contradict each other.
    """
    with blas().limit(limits=1):
        return _align(source, target, options, threads)


def _align(
    source: PointCloud | Prepared, target: PointCloud | Prepared, options: Options, threads: int
) -> Registration:
    seconds: dict[str, float] = {}
    begin = time.perf_counter()
    with stage(seconds, "prepare"), ThreadPoolExecutor(threads) as pool:
        source, target = pool.map(
            lambda cloud: cloud if isinstance(cloud, Prepared) else prepare(cloud, options.seed), (source, target)
        )
    best: tuple[Pair, float, list[Candidate]] | None = None
    for factor in scale_factors(source, target, options) if options.scale else (1.0,):
        scaled, given = (source, options) if factor == 1.0 else (source.scaled(factor), unscaled(options, factor))
        pair, candidates = look(scaled, target, given, threads, seconds)
        if best is None or candidates[0].confidence > best[2][0].confidence:
            best = pair, factor, candidates
    assert best is not None
    if options.refine and not options.scale:
        with stage(seconds, "polish"):
            best[2][0] = replace(best[2][0], T=best[0].exact(best[2][0].T))
    found = describe(*best, source, options, seconds)
    seconds["total"] = time.perf_counter() - begin
    return found


def look(
    source: Prepared, target: Prepared, options: Options, threads: int, seconds: dict[str, float]
) -> tuple[Pair, list[Candidate]]:
    """The candidates, best first, and the pair that they were found on: a coarse one where that leaves no doubt."""
    auto = isinstance(options.init, str) and options.init == "auto"
    if auto and options.voxel_size is None and not options.scale:
        with suppress(RegistrationError):  # too few voxels of that size
            pair = make_pair(source, target, options, threads, coarse=True)
            candidates = find(pair, replace(options, init="features"), seconds, refined=1)
            if candidates[0].confidence >= SURE:
                return pair, candidates
    pair = make_pair(source, target, options, threads)
    return pair, find(pair, options, seconds)


def make_pair(source: Prepared, target: Prepared, options: Options, threads: int = 1, *, coarse: bool = False) -> Pair:
    """The two clouds at their common voxel edge, with the encoders and the motions that the options ask for."""
    up = np.asarray(options.up, float)
    if not np.isfinite(up).all() or np.linalg.norm(up) == 0:
        raise FmrError(f"--up {options.up}: is no direction; give three numbers, not all zero")
    up /= np.linalg.norm(up)
    motion = Motion(
        options.dof, (float(up[0]), float(up[1]), float(up[2])), float(up @ (source.centre - target.centre))
    )
    edge = options.voxel_size or pair_edge(source, target) * (COARSE if coarse else 1.0)
    return Pair(
        source, target, fast_encoder(options.model), solver(options.model, options.device), bundled_local_encoder(),
        motion, edge=edge, keypoints=COARSE_KEYPOINTS if coarse else KEYPOINTS, normalize=options.normalize,
        points=options.points, iterations=options.iterations, robust=options.robust, seed=options.seed,
        threads=threads,
    )  # fmt: skip


def find(pair: Pair, options: Options, seconds: dict[str, float], refined: int = REFINED) -> list[Candidate]:
    """Candidates, best first, from the starts that the options name; "auto" goes on while none is settled."""
    candidates: list[Candidate] = []
    with stage(seconds, "describe"):
        pair.describe()
    for name, starts in start_makers(pair, options):
        with stage(seconds, name):
            ranked = sorted(
                ((pair.coincidence(s.T), s) for s in starts() if within_bounds(s.T, pair, options)), key=lambda x: -x[0]
            )
        with stage(seconds, "refine"):
            for i, (coincidence, start) in enumerate(ranked):
                enough = i >= refined or (candidates and candidates[0].confidence >= SETTLED)
                if enough and coincidence < RIVAL * ranked[0][0]:
                    break
                candidate = pair.candidate(start, options.refine, options.scale)
                if within_bounds(candidate.T, pair, options):
                    candidates = weighed([*candidates, candidate], pair)
        if candidates and candidates[0].confidence >= SETTLED:
            break
    if not candidates:  # every pose found lies beyond --max-angle or --max-shift
        here = Start(local_pose(np.eye(4), pair), "identity", [])
        candidates = weighed([pair.judged(here.T, here)], pair)
    return candidates


def start_makers(pair: Pair, options: Options) -> list[tuple[str, Callable[[], list[Start]]]]:
    """The kinds of start to try, in order: (stage, function)."""
    T, name = np.eye(4), options.init if isinstance(options.init, str) else "given"
    if name in ("given", "identity"):
        T = local_pose(np.eye(4) if name == "identity" else np.asarray(options.init, float), pair)
    if name in ("given", "identity", "centroid"):  # as it is; where that does not fit, where the solver goes from it
        return [("start", lambda: pair.from_pose(T, name)), ("solve", lambda: pair.from_solver(T, name))]
    makers: list[tuple[str, Callable[[], list[Start]]]] = [
        ("features", pair.from_features),
        ("search", pair.from_search),
    ]
    return [maker for maker in makers if name in ("auto", maker[0])]


def local_pose(T: np.ndarray, pair: Pair) -> np.ndarray:
    """T between the files' coordinates -> between the clouds' local frames."""
    local = T.copy()
    local[:3, 3] = transform_points(T, pair.source.centre[None])[0] - pair.target.centre
    return local


def file_pose(T: np.ndarray, pair: Pair) -> np.ndarray:
    """T between the local frames -> between the files' coordinates."""
    out = T.copy()
    out[:3, 3] = T[:3, 3] + pair.target.centre - T[:3, :3] @ pair.source.centre
    return out


def within_bounds(T: np.ndarray, pair: Pair, options: Options) -> bool:
    """Whether a local pose keeps to --max-angle and --max-shift."""
    shift = np.linalg.norm(T[:3, 3] + pair.target.centre - pair.source.centre)
    return (options.max_angle is None or angle_degrees(T) <= options.max_angle) and (
        options.max_shift is None or bool(shift <= options.max_shift)
    )


def weighed(candidates: list[Candidate], pair: Pair) -> list[Candidate]:
    """The candidates, best first, without those that are a better one's pose; each confidence given the others."""
    kept: list[Candidate] = []
    for c in sorted(candidates, key=lambda c: -c.odds):
        if not any(pair.same(c.T, k.T) for k in kept):
            kept.append(c)
    return [replace(c, confidence=p) for c, p in zip(kept, confidence.confidences([c.odds for c in kept]), strict=True)]


def describe(
    pair: Pair,
    factor: float,
    candidates: list[Candidate],
    source: Prepared,
    options: Options,
    seconds: dict[str, float],
) -> Registration:
    """The best candidate in the files' coordinates, with its covariance and alternatives.

    factor: what the source was multiplied by before it became pair.source.
    """
    best, others = candidates[0], candidates[1:]
    with stage(seconds, "verdict"):
        T = file_pose(best.T, pair)
        T[:3, :3] *= factor
        scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
        info = observability.information(pair.s, pair.t, best.T, np.zeros(3))
        length = pair.length / 2
        weak = observability.undetermined(info, length)
        alternatives = [
            {
                "T_target_source": file_pose(c.T, pair).tolist(),
                "confidence": c.confidence,
                "feature_error": pair.feature_error(c.T),
            }
            for c in others
            if c.odds >= 1  # by itself more likely right than not
        ]
        warnings = ["other poses fit about as well, see alternatives"] if alternatives else []
        before, after = pair.feature_error(local_pose(np.eye(4), pair)), pair.feature_error(best.T)
    return Registration(
        T_target_source=T,
        status="aligned" if best.confidence >= confidence.ALIGNED else "uncertain",
        confidence=best.confidence,
        overlap=best.evidence.overlap,
        inlier_rmse=best.evidence.inlier_rmse,
        feature_error_before=before,
        feature_error_after=after,
        feature_errors=best.errors,
        start=best.start,
        angle=angle_degrees(T),
        shift=float(np.linalg.norm(transform_points(T, source.centre[None])[0] - source.centre)),
        scale=scale,
        information=info,
        covariance=np.linalg.pinv(info, rcond=1e-12, hermitian=True),
        origin=pair.target.centre,
        undetermined=weak,
        alternatives=alternatives,
        evidence=asdict(best.evidence),
        voxel_size=pair.edge,
        points={
            "source": source.read,
            "target": pair.target.read,
            "source_used": len(pair.s.points),
            "target_used": len(pair.t.points),
        },
        seconds=seconds,
        options=options,
        warnings=warnings,
    )


def scale_factors(source: Prepared, target: Prepared, options: Options) -> list[float]:
    """Scales to try: a given pose's own, or some about the ratio of the clouds' root mean square sizes."""
    if not isinstance(options.init, str):
        return [float(np.cbrt(np.linalg.det(np.asarray(options.init, float)[:3, :3])))]
    sizes = float(np.sqrt((target.points**2).sum(1).mean() / (source.points**2).sum(1).mean()))
    return [sizes * s for s in SCALES]


def unscaled(options: Options, factor: float) -> Options:
    """The options for a source that was multiplied by ``factor``: a given pose without it."""
    if isinstance(options.init, str):
        return options
    rigid = np.array(options.init, float)
    rigid[:3, :3] /= factor
    return replace(options, init=rigid)
