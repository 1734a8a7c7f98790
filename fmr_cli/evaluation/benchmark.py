"""Methods on the pairs of a data set: what each found, whether it is right, and the figures that papers print."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import FmrError
from fmr_cli.evaluation.baselines import Baseline, filled, gicp, global_baselines_at, then_gicp
from fmr_cli.evaluation.datasets.pair import CorrespondenceRmse, DataSet, Loaded, Pair, correspondence_rmse, errors
from fmr_cli.feature_metric.numpy_solver import NumpySolver
from fmr_cli.geometry.frames import Frame, leave_frames
from fmr_cli.geometry.sampling import sample
from fmr_cli.io.files import reason
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import align

GRID = 50  # edges of the baselines' grid across the target, fewer of a sparse one, where a data set has no usual one


@dataclass(frozen=True)
class Estimate:
    """T_target_source (4, 4), and of a method that gives a verdict its status and confidence."""

    T_target_source: np.ndarray
    status: str = ""
    confidence: float = np.nan


Method = Callable[[np.ndarray, np.ndarray], Estimate]  # source (N, 3), target (M, 3), float64


@dataclass(frozen=True)
class Outcome:
    """What one method did on one pair. rre: degrees; rte: the scans' unit; rmse: of true correspondences, or NaN.

    status: "aligned" or "uncertain" of a method with a verdict, "failed" where there is no estimate, else "".
    seconds: from arrays in memory to the pose.
    """

    scene: str
    source: str
    target: str
    method: str
    right: bool
    rre: float
    rte: float
    rmse: float
    status: str
    confidence: float
    seconds: float
    message: str = ""


@dataclass(frozen=True)
class Summary:
    """One method's figures. recall, rre, rte: by the data set's own definition; NaN where nothing is right.

    recall_of_pairs: over all pairs whatever their scene. Of a method with a verdict: precision, the share of its
    `aligned` that is right; share, of all pairs that it calls `aligned`; found, of its right poses those it calls
    `aligned`. seconds: the median.
    """

    method: str
    pairs: int
    recall: float
    recall_of_pairs: float
    rre: float
    rte: float
    precision: float
    share: float
    found: float
    seconds: float
    failed: int


def methods(
    dataset: DataSet, options: Options, solver: NumpySolver, iterations: int, plain: bool, baselines: bool, threads: int
) -> tuple[dict[str, Method], list[str]]:
    """What is compared, by the name in the tables, and a line for each baseline that cannot run."""
    found: dict[str, Method] = {
        "fmr align": aligned(options, threads),
        "solver alone": alone(solver, iterations, True, options.seed),
    }
    if plain:
        found["solver alone, plain"] = alone(solver, iterations, False, options.seed)
    missing: list[str] = []
    if baselines:

        def voxel(source: np.ndarray, target: np.ndarray) -> float:
            return dataset.voxel or filled(float(np.ptp(target, axis=0).max()) / GRID, source, target)

        starts, missing = global_baselines_at(voxel)
        found |= {
            f"{name} + small_gicp": posed(then_gicp(start, voxel, threads=threads)) for name, start in starts.items()
        }
        found["small_gicp"] = posed(lambda source, target: gicp(source, target, voxel(source, target), threads=threads))
    return found, missing


def aligned(options: Options, threads: int) -> Method:
    """The product: `fmr align`, from nothing but the two clouds."""

    def run(source: np.ndarray, target: np.ndarray) -> Estimate:
        found = align(PointCloud(source), PointCloud(target), options, threads, hints=False)
        return Estimate(found.T_target_source, found.status, found.confidence)

    return run


def alone(solver: NumpySolver, iterations: int, robust: bool, seed: int, points: int = 1024) -> Method:
    """The IC solver alone from the centroids: one start, no search, no geometry."""

    def run(source: np.ndarray, target: np.ndarray) -> Estimate:
        origins = [cloud.mean(0) for cloud in (source, target)]
        unit = 2 * max(np.abs(c - o).max() for c, o in zip((source, target), origins, strict=True))
        s, t = (Frame(o, float(unit)) for o in origins)
        rng = np.random.default_rng(seed)
        Q, P = (frame.enter(sample(cloud, points, rng)) for frame, cloud in ((s, source), (t, target)))
        found = solver.solve(solver.template(P), Q, np.eye(4)[None], iterations, robust)
        return Estimate(leave_frames(found.g[0].astype(np.float64), s, t))

    return run


def posed(baseline: Baseline) -> Method:
    return lambda source, target: Estimate(baseline(source, target))


def outcomes(pair: Pair, dataset: DataSet, methods: Mapping[str, Method]) -> list[Outcome]:
    """Every method on one pair. A scan that cannot be read, and a method that raises, are outcomes that failed."""
    try:
        loaded = pair.load()
    except FmrError as error:
        return [failed(pair, name, str(error)) for name in methods]
    return [outcome(pair, name, method, loaded, dataset) for name, method in methods.items()]


def outcome(pair: Pair, name: str, method: Method, loaded: Loaded, dataset: DataSet) -> Outcome:
    began = time.perf_counter()
    try:
        found = method(loaded.source, loaded.target)
    except Exception as error:  # whatever one method runs into on one pair, the others go on
        return failed(pair, name, f"{type(error).__name__}: {reason(error)}", time.perf_counter() - began)
    seconds = time.perf_counter() - began
    T = found.T_target_source
    rre, rte = errors(T, loaded, dataset.centred)
    rmse = correspondence_rmse(T, loaded) if isinstance(dataset.right, CorrespondenceRmse) else np.nan
    return Outcome(pair.scene, pair.source, pair.target, name, dataset.right(T, loaded), rre, rte, rmse, found.status,
                   found.confidence, seconds)  # fmt: skip


def failed(pair: Pair, name: str, message: str, seconds: float = 0.0) -> Outcome:
    return Outcome(pair.scene, pair.source, pair.target, name, False, 180.0, np.inf, np.nan, "failed", np.nan, seconds,
                   " ".join(message.split()))  # fmt: skip


def summarise(rows: Iterable[Outcome], by_scene: bool) -> list[Summary]:
    """A method each, in the order of their first rows.

    by_scene: recall is the mean over scenes, the errors the means over scenes of the medians of what is right there
    (3DMatch); else the means over all pairs, and over all that are right.
    """
    rows = list(rows)
    found = []
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method]
        scenes = [[r for r in own if r.scene == s] for s in dict.fromkeys(r.scene for r in own)] if by_scene else [own]
        centre = np.median if by_scene else np.mean
        right = [[row for row in scene if row.right] for scene in scenes]
        verdict = [row for row in own if row.status in ("aligned", "uncertain")]
        called = [row for row in verdict if row.status == "aligned"]
        found.append(Summary(
            method, len(own),
            mean([len(r) / len(scene) for r, scene in zip(right, scenes, strict=True)]),
            mean([row.right for row in own]),
            mean([centre([row.rre for row in r]) for r in right if r]),
            mean([centre([row.rte for row in r]) for r in right if r]),
            mean([row.right for row in called]),
            len(called) / len(own) if verdict else np.nan,
            mean([row.status == "aligned" for row in verdict if row.right]),
            float(np.median([row.seconds for row in own])),
            sum(row.status == "failed" for row in own),
        ))  # fmt: skip
    return found


def mean(values: Sequence[Any]) -> float:
    return float(np.mean(values)) if values else np.nan
