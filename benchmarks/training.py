"""What `fmr train --unsupervised` gains: a place, scanned by a sensor that the bundled model never saw, half learnt.

    python -m benchmarks.training building --out /tmp/place --minutes 10     # or street, object
    python -m benchmarks.training building --out /tmp/place --model m.safetensors --starts   # a model, cheaply
    python -m benchmarks.training ../shared/data/dragon --out /tmp/dragon --minutes 1        # scans and their poses
    python -m benchmarks.training drive/ --halves --every 2 --out /tmp/drive --minutes 10    # a drive's two halves

Sixty scans by a solid-state LiDAR (a square view of 70 deg, random directions, 1.5 cm of noise) or, of the object, a
depth camera (6 mm, sparse), made once per --out, each in a frame of its own; or the scans of a folder, with a file
NAME.pose.txt (4x4, scan to world) beside each, or poses.txt. Trained on every other one, or on the first half, without
poses; tested on pairs among the others, drawn once, whose smaller share of overlap is 10 to 30, 30 to 60 % and more.
Said of each band, before and after: pairs right (5 deg, and 2 % of the larger scan's size) with 95 % bounds (Wilson),
`aligned`, wrong and yet `aligned`, right by the first consensus pose, the share of right matches, seconds. --out gets
the table, report.json, and its picture, gain.png.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common import CORES
from benchmarks.multiway import building
from fmr_cli import Options, PointCloud, align, read_cloud, write_cloud
from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.evaluation.datasets.posed import scans_with_poses
from fmr_cli.registration import hypotheses, prepare
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.pipeline import one_blas_thread
from fmr_cli.registration.prepared import Prepared
from fmr_cli.report import plots
from fmr_cli.synthetic.contradicting import lump
from fmr_cli.synthetic.scenes import Scene, scan, street
from fmr_cli.synthetic.sensors import overlap

KINDS = "building", "street", "object"
PLACES, OFFICES = 60, 2  # scans of a place; offices of the building that they are taken in
BANDS = {"10 to 30 %": (0.1, 0.3), "30 to 60 %": (0.3, 0.6), "60 % and more": (0.6, 1.01)}
DEGREES, SHARE = 5.0, 0.02  # right within
VIEW = 70.0  # degrees, of the solid-state LiDAR
NOISE = 0.015  # m, of its ranges


@dataclass(frozen=True)
class Case:
    """A pair of files whose pose is known: T_target_source, files' coordinates."""

    source: str
    target: str
    T_target_source: list[list[float]]
    overlap: float


def rays(towards: np.ndarray, count: int, view: float, rng: np.random.Generator) -> np.ndarray:
    """Random unit directions (count, 3) in a square view about ``towards``."""
    half = np.tan(np.radians(view / 2))
    local = np.column_stack([np.ones(count), rng.uniform(-half, half, (count, 2))])
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    return Rotation.align_vectors(towards[None], np.array([[1.0, 0, 0]]))[0].apply(local)


def views(kind: str, rng: np.random.Generator) -> list[np.ndarray]:
    """PLACES scans (n, 3) of one scene, in its frame."""
    found: list[np.ndarray] = []
    if kind == "object":
        scene = lump(rng).scene
        while len(found) < PLACES:
            d = rng.normal(size=3)
            d /= np.linalg.norm(d)
            points = scan(scene, 3 * d, rays(-d, 9000, 40, rng), rng, 0.0, 10)
            found.append(points + rng.normal(0, 0.006, points.shape))
        return found
    scene, eyes = building(rng) if kind == "building" else (street(rng, 100.0), [])
    rooms = eyes[: 2 * OFFICES : 2]
    while len(found) < PLACES:
        if kind == "building":
            eye = rooms[len(found) // 2 % OFFICES] + np.append(rng.normal(0, 0.5, 2), 0)
            heading, dip, count = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.0), 12_000
        else:
            eye = np.array([rng.uniform(-25, 25), rng.uniform(-2, 2), 1.8])
            heading, dip, count = rng.normal(0, 0.6) + np.pi * (rng.random() < 0.3), -0.05, 20_000
        towards = np.array([np.cos(heading) * np.cos(dip), np.sin(heading) * np.cos(dip), np.sin(dip)])
        points = ranged(scene, eye, rays(towards, count, VIEW, rng), rng)
        if len(points) > 2000:
            found.append(points)
    return found


def ranged(scene: Scene, eye: np.ndarray, directions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the rays meet, each range with noise."""
    points = scan(scene, eye, directions, rng, 0.0, 60.0)
    away = points - eye
    return points + away / np.linalg.norm(away, axis=1, keepdims=True) * rng.normal(0, NOISE, (len(points), 1))


def posed(folder: Path, every: int, halves: bool) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The scans (n, 3) of a folder in its world's frame, and T_scan_world of each.

    In the order of their names, one in ``every``; or with ``halves`` one of the first half and one of the second in
    turn.
    """
    scans = scans_with_poses(folder)[::every]
    half = len(scans) // 2
    if halves:
        scans = [scan for both in zip(scans[:half], scans[half:], strict=False) for scan in both]
    return [transform_points(T, read_cloud(file).points) for file, T in scans], [np.linalg.inv(T) for _, T in scans]


def made_up(kind: str, rng: np.random.Generator) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The scans (n, 3) of a made-up place in its frame, and T_scan_place of each: any."""
    clouds, poses = views(kind, rng), []
    for points in clouds:
        T = np.eye(4)
        T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        T[:3, 3] = -T[:3, :3] @ points.mean(0) + rng.normal(0, 1, 3)
        poses.append(T)
    return clouds, poses


def make(kind: str, out: Path, seed: int, every: int = 1, halves: bool = False) -> list[Case]:
    """The scans in ``out``/learn and ``out``/test, made once, and all cases among the latter."""
    cases = out / "cases.json"
    if not cases.is_file():
        rng = np.random.default_rng(seed)
        clouds, poses = made_up(kind, rng) if kind in KINDS else posed(Path(kind), every, halves)
        names = [out / ("learn", "test")[n % 2] / f"scan_{n:03d}.ply" for n in range(len(clouds))]
        for name, points, T in zip(names, clouds, poses, strict=True):
            name.parent.mkdir(parents=True, exist_ok=True)
            write_cloud(name, PointCloud(transform_points(T, points)))
        found, edges = [], [prepare(PointCloud(points)).edge for points in clouds]  # of about 5,000 voxels
        for i, j in combinations(range(1, len(clouds), 2), 2):
            shared = min(overlap(clouds[i], clouds[j], 1.5 * max(edges[i], edges[j])))
            if shared >= 0.1:
                T = poses[j] @ np.linalg.inv(poses[i])
                found.append({"source": str(names[i]), "target": str(names[j]), "T_target_source": T.tolist(),
                              "overlap": shared})  # fmt: skip
        cases.write_text(json.dumps(found))
    return [Case(**case) for case in json.loads(cases.read_text())]


@cache
def prepared(path: str) -> Prepared:
    return prepare(read_cloud(path))


def look(case: Case, model: Path | None, starts: bool) -> dict[str, object]:
    """What ``align`` makes of a case, or with ``starts`` its matches and first consensus pose alone."""
    source, target, truth = prepared(case.source), prepared(case.target), np.array(case.T_target_source)
    begin = time.perf_counter()
    options = Options(model=model)
    said: dict[str, object] = {"overlap": case.overlap}
    if not starts:
        found = align(source, target, options, threads=1)
        said |= {"right": right(source, target, truth, found.T_target_source), "aligned": found.status == "aligned"}
    said["seconds"] = time.perf_counter() - begin
    with one_blas_thread():
        pair = make_pair(source, target, options, 1, 1.0, 1000)
        poses = hypotheses.agreed(pair, *pair.matches)[0]
    first = pair.leave_centred(poses[0]) if len(poses) else np.eye(4)
    said["first"] = right(source, target, truth, first, degrees=15.0, share=0.05)
    said["matches"] = pair.inlier_count(pair.enter_centred(truth)) / max(len(pair.matches[0]), 1)
    return said


def right(
    source: Prepared, target: Prepared, truth: np.ndarray, T: np.ndarray, degrees: float = DEGREES, share: float = SHARE
) -> bool:
    """Whether a pose is right: its rotation, and the mean displacement of the source's points."""
    points = source.frame.leave(source.points[::20])
    off = np.linalg.norm(transform_points(T, points) - transform_points(truth, points), axis=1).mean()
    size = max(np.ptp(x.points, axis=0).max() for x in (source, target))
    return bool(off < share * size and angle_degrees(np.linalg.inv(truth) @ T) < degrees)


def chosen(cases: list[Case], pairs: int, seed: int) -> list[Case]:
    """At most ``pairs`` of each band."""
    rng = np.random.default_rng(seed)
    found = []
    for low, high in BANDS.values():
        band = [c for c in cases if low <= c.overlap < high]
        found += [band[i] for i in rng.permutation(len(band))[:pairs]]
    return found


def test(cases: list[Case], models: dict[str, Path | None], starts: bool) -> dict[str, dict[str, dict[str, object]]]:
    """Each model on the same cases, a summary of each band."""
    report: dict[str, dict[str, dict[str, object]]] = {}
    with ProcessPoolExecutor(CORES, get_context("spawn")) as pool:
        for name, model in models.items():
            rows = list(pool.map(partial(look, model=model, starts=starts), cases, chunksize=4))
            report[name] = {}
            for band, (low, high) in BANDS.items():
                here = [r for r in rows if low <= float(str(r["overlap"])) < high]
                if here:
                    report[name][band] = summary(here)
                    print(f"{name:8s} {band}: {report[name][band]}", flush=True)
    return report


def summary(rows: list[dict]) -> dict[str, object]:
    """Counts of a band."""
    said: dict[str, object] = {"pairs": len(rows)}
    if "right" in rows[0]:
        hits = sum(r["right"] for r in rows)
        said |= {
            "right": hits,
            "bounds": [round(x, 2) for x in plots.binomial(hits / len(rows), len(rows))],
            "aligned": sum(r["aligned"] for r in rows),
            "wrong": sum(r["aligned"] and not r["right"] for r in rows),
            "seconds": round(float(np.median([r["seconds"] for r in rows])), 2),
        }
    said["first"] = sum(r["first"] for r in rows)
    said["matches"] = round(float(np.mean([r["matches"] for r in rows])), 3)
    return said


def picture(path: Path, report: dict[str, dict[str, dict[str, Any]]], title: str) -> None:
    """The share that is right by each model, band by band, with its bounds; an image file by the path's suffix."""
    series, bands = [], list(next(iter(report.values())))
    for name, rows in report.items():
        shares = [row["right"] / row["pairs"] for row in rows.values()]
        low, high = zip(*(row["bounds"] for row in rows.values()), strict=True)
        series.append(plots.Series(name, range(len(bands)), shares, low, high))
    counts = [", ".join(str(rows[band]["right"]) for rows in report.values()) for band in bands]
    pairs = [row["pairs"] for row in next(iter(report.values())).values()]
    named = [f"{band}\n{count} of {of}" for band, count, of in zip(bands, counts, pairs, strict=True)]
    with plots.figure(path, plots.COLUMN, 0.7 * plots.COLUMN) as figure:
        axes = figure.subplots()
        plots.dots(axes, named, series)
        axes.set(title=title, xlim=(0, 1.02), xlabel="share of pairs that is right, 95 % interval")
        plots.names_above(figure, list(report))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", help=f"{', '.join(KINDS)}, or a folder of scans with their poses")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, nargs="*", default=[])
    parser.add_argument("--model", type=Path, nargs="*", default=[], help="models to test as they are")
    parser.add_argument("--pairs", type=int, default=200, help="of each band, at most")
    parser.add_argument("--starts", action="store_true", help="matches and the first consensus pose alone")
    parser.add_argument("--every", type=int, default=1, help="of a folder, one scan in so many")
    parser.add_argument("--halves", action="store_true", help="of a folder, learn from its first half")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    cases = make(given.kind, given.out, given.seed, given.every, given.halves)
    print({band: sum(low <= c.overlap < high for c in cases) for band, (low, high) in BANDS.items()})
    models: dict[str, Path | None] = {"before": None, **{m.stem if m.stem != "model" else m.parent.name: m
                                                         for m in given.model}}  # fmt: skip
    for minutes in given.minutes:
        run = given.out / f"run_{minutes:g}"
        if not (run / "model.safetensors").is_file():
            command = [sys.executable, "-m", "fmr_cli.cli", "train", "--unsupervised", str(given.out / "learn")]
            subprocess.run([*command, "--minutes", str(minutes), "-o", str(run)], check=True)
        models[f"{minutes:g} min"] = run / "model.safetensors"
    report = test(chosen(cases, given.pairs, given.seed), models, given.starts)
    (given.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    if not given.starts:
        picture(given.out / "gain.png", report, f"{Path(given.kind).name}, scans that were not trained on")


if __name__ == "__main__":
    main()
