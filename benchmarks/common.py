"""What the benchmarks share: clouds, the paper's protocols, the tools a user would pick instead, tables and clocks."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.cores import usable_cores
from fmr_cli.evaluation.baselines import Baseline, gicp, global_baselines, then_gicp
from fmr_cli.io import SUFFIXES, read_cloud
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import align
from fmr_cli.report import plots
from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.shapes import shapes

# How source and target differ, see make_pair: the paper's, and any rotation, and part overlap.
PROTOCOLS = ("copy", "so3", "resample", "noise", "density", "overlap90", "overlap80", "overlap70")
CORES = usable_cores()
console = Console(width=150, highlight=False)


def room_clouds(count: int, points: int, seed: int) -> list[np.ndarray]:
    """Scans (points, 3) of that many procedural rooms by a depth camera, metres, in random order."""
    clouds = []
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        room = scenes.room(rng)
        views: list[np.ndarray] = []
        while sum(map(len, views)) < points:
            views.append(scenes.room_scan(room, rng, np.array([*rng.normal(0, 0.3, 2), 1.4]), rng.uniform(0, 6.3)))
        clouds.append(rng.permutation(np.concatenate(views))[:points])
    return clouds


def shape_clouds(count: int, points: int, seed: int) -> list[np.ndarray]:
    """Procedural objects (points, 3) of half extent 1."""
    return list(2.0 * shapes(count, points, seed).astype(float))


def folder_clouds(folder: Path, points: int | None, seed: int) -> list[np.ndarray]:
    """Every file of the folder that can be read, at most ``points`` of its points, in random order."""
    rng = np.random.default_rng(seed)
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.endswith(".pose.txt"))
    return [rng.permutation(read_cloud(p, attributes=False).points)[:points] for p in files]


def random_pose(rng: np.random.Generator, degrees: float | None, shift: float) -> np.ndarray:
    """A rotation of up to ``degrees`` about any axis (None: uniform in SO(3)) and a shift of up to ``shift``."""
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = Rotation.random(random_state=rng)
    if degrees is not None:
        turn = Rotation.from_rotvec(axis * np.radians(rng.uniform(0, degrees)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), direction * rng.uniform(0, shift)
    return T


def make_pair(protocol: str, points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target and T_target_source of a cloud, which is turned by up to 60 deg and shifted by up to 1.

    copy: the same points; so3: turned by any rotation; resample: disjoint random halves; noise: these, with 1 % of the
    largest half extent; density: the source keeps 10 %; overlapNN: disjoint halves with NN % in common.
    """
    source = target = points
    if protocol in ("resample", "noise") or protocol.startswith("overlap"):
        order = rng.permutation(len(points))
        source, target = points[order[::2]], points[order[1::2]]
    if protocol.startswith("overlap"):
        keep, side = int(protocol[-2:]) / 100, rng.normal(size=3)
        low, high = np.quantile(points @ side, [(1 - keep) / (2 - keep), 1 / (2 - keep)])
        source, target = source[source @ side >= low], target[target @ side <= high]
    if protocol == "density":
        source = source[rng.permutation(len(source))[: len(source) // 10]]
    if protocol == "noise":
        sigma = 0.01 * np.abs(points - points.mean(0)).max()
        source, target = (x + rng.normal(size=x.shape) * sigma for x in (source, target))
    T = random_pose(rng, None if protocol == "so3" else 60.0, 1.0)
    return source, transform_points(T, target), T


def ways(voxel: float, reach: float) -> dict[str, Baseline]:
    """fmr and the peers that are installed, each end to end; voxel edge and GICP's reach are the peers'."""
    found: dict[str, Baseline] = {
        "fmr": lambda source, target: align(PointCloud(source), PointCloud(target), Options(), CORES).T_target_source
    }
    peers, missing = global_baselines(voxel)
    for line in missing:
        console.print(line)
    found |= {
        f"{name} + small_gicp": then_gicp(start, lambda source, target: voxel, reach / voxel, CORES)
        for name, start in peers.items()
    }
    found["small_gicp from the identity"] = partial(gicp, voxel=voxel, reach=reach, threads=CORES)
    return found


def interleaved(runs: Mapping[str, Callable[[], Any]], repeats: int, warm: bool = False) -> dict[str, list[float]]:
    """Seconds of each run, one after the other in every round so that all see the machine alike.

    warm: each has run before; else a first round does not count.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + (not warm)):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: all_[-repeats:] for name, all_ in seconds.items()}


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """The rows as a table; a column for each key."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = Table(*columns, title=title, title_justify="left")
    for row in rows:
        cells = (row.get(column, "") for column in columns)
        table.add_row(*(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells))
    console.print(table)


def save(out: Path | None, report: dict[str, Any], draw: Callable[[Any], None], height: float = 3.4) -> None:
    """OUT.json with the report, and OUT.png where matplotlib is installed; draw(figure), so many inches high."""
    if out is None:
        return
    out.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")
    if not plots.can_plot():
        console.print("plot: skipped (matplotlib is not installed)")
        return
    with plots.figure(out.with_suffix(".png"), plots.PAGE, height) as figure:
        draw(figure)
