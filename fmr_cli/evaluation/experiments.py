"""The paper's experiments (Huang et al. 2020, Figures 3 to 7 and the 7-Scenes table), on any clouds."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from fmr_cli.errors import FmrError
from fmr_cli.evaluation.heldout import Errors, Setting, draw, errors
from fmr_cli.evaluation.methods import Method
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.solver import make_template, solve
from fmr_cli.geometry import se3
from fmr_cli.geometry.sampling import to_size
from fmr_cli.geometry.voxels import voxel_downsample
from fmr_cli.io import read_cloud
from fmr_cli.io.folders import find_scans

GRID = 100  # voxel edges in a cloud's size: evens out the density, and is finer than the spacing of 1,024 points
SHIFT = 0.8  # of the unit box, the paper's; centring takes it out
SHOWN = (1, 5, 10)  # iterations of the feature maps, as in the paper's Figure 7: the first, half-way, the last
LEAST_POINTS = 100  # of a scan: fewer say nothing about a surface
How = TypeVar("How")  # what a level does to a pair


SOLVER: tuple[tuple[str, str], ...] = (
    ("success", "share below 5 deg"),
    ("rotation_median", "median rotation error, deg"),
    ("shift_median", "median shift error"),
)


@dataclass(frozen=True)
class Experiment(Generic[How]):
    """A series of settings. axis: what the levels are; levels: (value on the axis, setting).

    measures: what its plots show, (field of ``Row``, label).
    """

    name: str
    axis: str
    levels: tuple[tuple[float, How], ...]
    measures: tuple[tuple[str, str], ...] = SOLVER


_start = Setting("", (0.0, 60.0), SHIFT)
_same = replace(_start, resample=False)
_at_40 = Setting("", (40.0, 40.0), SHIFT)
_ANGLES = (0, 10, 20, 30, 40, 50, 60, 70, 80, 100, 120, 140, 160, 180)

EXPERIMENTS = {
    e.name: e
    for e in (
        Experiment("rotation", "initial rotation, deg", tuple((a, replace(_same, rotation=(a, a))) for a in _ANGLES)),
        Experiment("density", "share of points", tuple((v, replace(_same, density=v)) for v in (1, 0.5, 0.25, 0.1))),
        Experiment("noise", "deviation", tuple((v, replace(_start, noise=v)) for v in (0, 0.005, 0.01, 0.02, 0.04))),
        Experiment("overlap", "overlap", tuple((v, replace(_at_40, overlap=v)) for v in (1, 0.9, 0.8, 0.7, 0.6, 0.5))),
        Experiment("scenes", "largest rotation, deg", ((60, _same),)),
    )
}


@dataclass
class Clouds:
    """A set of clouds: points (S, M, 3) float32, normalised; skipped: a line for each file that is left out."""

    name: str
    points: Tensor
    skipped: list[str]


@dataclass(frozen=True)
class Row:
    """What a method did at one level. Rotations in degrees; shifts in units of the normalised cloud.

    success: the share that is right, below 5 deg if not said otherwise. What an experiment does not measure is None:
    limit_median, the median rotation error that noise allows (``cramer_rao``), and limit_ratio, the median of the
    error over it; scale_median, the error of the scale as a share; aligned_right, aligned_wrong, the shares of the
    pairs that are ``aligned`` and right, and ``aligned`` and not.
    """

    experiment: str
    clouds: str
    method: str
    level: float
    pairs: int
    success: float
    rotation_mean: float
    rotation_median: float
    shift_mean: float
    shift_median: float
    rmse_mean: float
    rmse_median: float
    seconds: float
    limit_median: float | None = None
    limit_ratio: float | None = None
    scale_median: float | None = None
    aligned_right: float | None = None
    aligned_wrong: float | None = None


def read_clouds(path: Path, count: int | None, points: int, device: torch.device) -> Clouds:
    """The first ``count`` scans or meshes of a folder (or file), 2 x ``points`` of each. Raises FmrError."""
    found: list[np.ndarray] = []
    skipped: list[str] = []
    rng = np.random.default_rng(0)
    for file in find_scans([path]):
        if len(found) == count:
            break
        try:
            cloud = read_cloud(file, attributes=False, mesh_points=8 * points).points
        except FmrError as error:
            skipped.append(str(error))
            continue
        extent = float(np.ptp(cloud, axis=0).max())
        if len(cloud) < LEAST_POINTS or not extent > 0:
            skipped.append(f"{file}: too small, {len(cloud)} points where {LEAST_POINTS} are needed")
            continue
        thin = voxel_downsample(cloud, extent / GRID)
        found.append(to_size(thin if len(thin) >= 2 * points else cloud, 2 * points, rng))
    if not found:
        raise FmrError(f"{path}: no scan to evaluate on; the first: {skipped[0]}")
    return Clouds(path.name or str(path), torch.from_numpy(np.stack(found)).to(device), skipped)


def at_level(
    experiment: Experiment[Setting],
    number: int,
    clouds: Clouds,
    methods: dict[str, Method],
    pairs: int,
    points: int,
    seed: int,
) -> list[Row]:
    """Every method on the same ``pairs`` random pairs at one level, by its number."""
    level, setting = experiment.levels[number]
    drawn = draw(clouds.points, setting, pairs, points, seed + number)
    rows = []
    for name, method in methods.items():
        started = time.perf_counter()
        estimate = method(drawn)
        seconds = (time.perf_counter() - started) / pairs
        e = errors(estimate, drawn.truth)
        rows.append(make_row(experiment, clouds.name, name, level, e, e.success, seconds))
    return rows


def make_row(
    experiment: Experiment[Any], clouds: str, method: str, level: float, e: Errors, success: float, seconds: float,
    **more: float | None,
) -> Row:  # fmt: skip
    """The row of a method's errors at one level; more: the fields that not every experiment measures."""
    means, medians = ([float(f(x)) for x in (e.rotation, e.translation, e.rmse)] for f in (np.mean, np.median))
    return Row(
        experiment.name, clouds, method, float(level), len(e.rotation), success, means[0], medians[0],
        means[1], medians[1], means[2], medians[2], seconds, **more,
    )  # fmt: skip


@torch.inference_mode()
def feature_maps(encoder: Encoder, clouds: Clouds, points: int, seed: int) -> dict[int, tuple[Tensor, Tensor]]:
    """Iteration -> F(P) and F(g Q) as images (h, h), of the first cloud turned by 40 deg (the paper's Figure 7)."""
    pair = draw(clouds.points[:1], replace(_at_40, resample=False), 1, points, seed)
    template = make_template(encoder, pair.target)
    side = int(np.ceil(np.sqrt(encoder.feature_dim)))

    def image(feature: Tensor) -> Tensor:
        return torch.nn.functional.pad(feature[0], (0, side * side - encoder.feature_dim)).reshape(side, side).cpu()

    maps = {}
    for iterations in SHOWN:
        # The paper's plain steps: each is the same however many follow, so that stopping early shows the way.
        start = torch.eye(4, device=pair.source.device)[None]
        g = solve(encoder, template, pair.source, start, iterations, robust=False).g
        maps[iterations] = (image(template.feature), image(encoder(se3.transform(g, pair.source))))
    return maps
