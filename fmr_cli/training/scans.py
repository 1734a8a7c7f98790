"""Scans as training material: files found, cut into overlapping crops at several scales, sampled to one size."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.errors import FmrError
from fmr_cli.geometry.sampling import sample, to_size
from fmr_cli.geometry.voxels import voxel_downsample
from fmr_cli.io import read_cloud, read_transform
from fmr_cli.synthetic import scenes

CROPS_OF_A_SCAN = 24  # at most: balls of a quarter to all of a scan's radius then cover it several times
SMALLEST = 256  # points of a crop on its grid: half of what a step sees of a cloud
RADII = (0.25, 1.0)  # of a crop, as shares of the distance that 90 % of the scan's points lie within
GRID = 30  # voxel edges in a crop's radius: evens out a LiDAR's rings, keeps some thousand points
SCENE_CROPS = 12  # of a made-up scan: half as many as of a user's, as there is no lack of such scans
TRIES = 3  # crops drawn for each that is wanted: balls about points at a scan's border hold too little


@dataclass
class Material:
    """clouds: (S, M, 3) float32, each centred and of half extent 0.5; scan: (S,) which file each is from."""

    clouds: np.ndarray
    scan: np.ndarray
    files: list[Path]
    skipped: list[str]


def load_material(
    files: list[Path],
    crops: int,
    cloud_points: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda i, n: None,
) -> Material:
    """Reads every file and cuts it up. Files that cannot be read are skipped, and said so in ``skipped``.

    At most ``crops`` clouds in all. Raises FmrError where nothing is left to train on.
    """
    each = int(np.clip(crops // len(files), 1, CROPS_OF_A_SCAN))
    rng = np.random.default_rng(seed)
    clouds: list[np.ndarray] = []
    scan: list[int] = []
    skipped: list[str] = []
    for i, path in enumerate(files):
        progress(i, len(files))
        try:
            points = read_cloud(path, attributes=False, mesh_points=4 * cloud_points).points
        except FmrError as error:
            skipped.append(str(error))
            continue
        cut = crops_of(points, each, cloud_points, rng)
        if not cut:
            skipped.append(f"{path}: too small, {len(points)} points where {SMALLEST} are needed")
        clouds += cut
        scan += [i] * len(cut)
        if len(clouds) >= crops:
            break
    progress(len(files), len(files))
    if not clouds:
        raise FmrError(f"nothing to train on in {len(files)} files; the first: {skipped[0]}")
    return Material(np.stack(clouds), np.array(scan), files, skipped)


def crops_of(points: np.ndarray, count: int, cloud_points: int, rng: np.random.Generator) -> list[np.ndarray]:
    """The whole scan and ``count`` - 1 balls around random points of it: (cloud_points, 3) float32 each, normalised."""
    points = points - np.median(points, 0)
    reach = float(np.quantile(np.linalg.norm(points, axis=1), 0.9))
    if not reach > 0:
        return []
    found: list[np.ndarray] = []
    for attempt in range(1 + TRIES * (count - 1)):
        if len(found) == count:
            break
        radius, inside = reach, points[np.linalg.norm(points, axis=1) <= 1.5 * reach]
        if attempt:
            radius = reach * np.exp(rng.uniform(*np.log(RADII)))
            inside = points[np.linalg.norm(points - points[rng.integers(len(points))], axis=1) < radius]
        if len(inside) < SMALLEST:
            continue
        thin = voxel_downsample(inside, radius / GRID)
        if len(thin) < SMALLEST:
            thin = inside  # a sparse scan: its own points, as they are
        found.append(to_size(thin, cloud_points, rng))
    return found


def scene_scan(rng: np.random.Generator) -> np.ndarray:
    """A scan (n, 3) of a fresh procedural scene: half of them rooms, a quarter streets, a quarter things."""
    kind = rng.random()
    if kind < 0.5:
        eye = np.array([*rng.normal(0, 0.7, 2), rng.uniform(1, 1.8)])
        return scenes.room_scan(scenes.room(rng), rng, eye, rng.uniform(0, 2 * np.pi), int(rng.integers(1, 8)))
    if kind < 0.75:
        return scenes.street_scan(scenes.street(rng), rng, np.array([rng.uniform(-40, 40), rng.uniform(-2, 2), 1.8]))
    return scenes.thing_scan(scenes.thing(rng), rng, rng.normal(size=3), int(rng.integers(1, 8)))


def scene_crops(
    count: int, cloud_points: int, seed: int, progress: Callable[[int, int], None] = lambda i, n: None
) -> list[np.ndarray]:
    """``count`` scans of procedural scenes, each as its crops (SCENE_CROPS at most, cloud_points, 3)."""
    found: list[np.ndarray] = []
    attempt = 0
    while len(found) < count:
        progress(len(found), count)
        rng = np.random.default_rng((seed, attempt))
        attempt += 1
        points = scene_scan(rng)
        if len(points) >= SMALLEST and (cut := crops_of(points, SCENE_CROPS, cloud_points, rng)):
            found.append(np.stack(cut))
    return found


def read_pairs(path: Path) -> list[tuple[Path, Path, np.ndarray]]:
    """Labelled pairs of a CSV file: source, target (relative to it), T_target_source. Raises FmrError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except FileNotFoundError:
        raise FmrError(f"{path}: no such file; give a CSV with the columns source, target, transform") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise FmrError(f"{path}: is no CSV file ({error}); check how it was written") from None
    if not rows or not {"source", "target", "transform"} <= set(rows[0]):
        raise FmrError(f"{path}: needs a first line with the columns source, target, transform, and a line a pair")
    for number, row in enumerate(rows, 2):
        if not all(row[name] for name in ("source", "target", "transform")):
            raise FmrError(f"{path}: line {number} lacks source, target or transform; fill it in")
    folder = path.parent
    return [(folder / r["source"], folder / r["target"], read_transform(folder / r["transform"])) for r in rows]


def load_pairs(path: Path, cloud_points: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Labelled pairs of a CSV file (source, target, transform; paths relative to it): two arrays (S, M, 3), float32.

    The source is moved onto its target; both are centred on the target and scaled as one. Raises FmrError.
    """
    rng = np.random.default_rng(seed)
    sources: list[np.ndarray] = []
    targets: list[np.ndarray] = []
    for source_path, target_path, T in read_pairs(path):
        source, target = (read_cloud(file, attributes=False).points for file in (source_path, target_path))
        both = []
        edge = np.ptp(target, axis=0).max() / (2 * GRID)
        for points in (transform_points(T, source), target):
            thin = voxel_downsample(points, edge)
            some = sample(thin if len(thin) >= SMALLEST else points, cloud_points, rng)
            both.append(some[np.resize(rng.permutation(len(some)), cloud_points)])
        centre, size = both[1].mean(0), np.abs(both[1] - both[1].mean(0)).max()
        for list_, points in zip((sources, targets), both, strict=True):
            list_.append(((points - centre) * (0.5 / size)).astype(np.float32))
    return np.stack(sources), np.stack(targets)
