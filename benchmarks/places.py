"""Scans in a map: is the place found, and is the verdict right, where the map is many times as large as a scan?

    python -m benchmarks.places --size 500 --scans 100

A made-up town of ``size`` metres: houses, cars, poles and trees along a grid of streets. The map is fused from
revolutions of a LiDAR every 15 m along the streets, on a grid of 0.3 m; the scans are revolutions of another one, with
32 beams and 2 cm of noise, anywhere on the streets, turned at will. Right: within 5 deg and 2 m, as KITTI's pairs.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from benchmarks.common import CORES, console, random_pose
from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.voxels import voxel_downsample
from fmr_cli.registration import Options, align, prepare
from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.scenes import BALL, CUBE, CYLINDER, Scene, lidar_rays

BLOCK = 90.0  # m, from street to street, give or take a fifth
REACH, EYE = 60.0, 1.9  # m, of the scanner, and its height
EVERY, GRID, NOISE = 15.0, 0.3, 0.02  # m
DEGREES, SHIFT = 5.0, 2.0  # right within

Solid = tuple[int, ArrayLike, ArrayLike]  # kind, centre, half sizes


def streets(size: float, rng: np.random.Generator) -> np.ndarray:
    """Where streets lie along an axis, m."""
    count = max(round(size / BLOCK), 2)
    return (np.arange(count) + 0.5) * size / count + rng.uniform(-0.1, 0.1, count) * BLOCK


def town(size: float, across: np.ndarray, along: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Kinds (n,), maps (n, 4, 4) and places (n, 2) of its solids; streets at y = across and x = along."""
    scene, half = Scene(), rng.uniform(4, 7)
    for number, (lines, turned) in enumerate(((across, 0.0), (along, np.pi / 2))):
        crossing = (along, across)[number]
        for line in lines:
            for side in (-1, 1):
                x = 0.0
                while x < size:
                    front, depth, height = rng.uniform(6, 22), rng.uniform(4, 9), rng.uniform(2, 8)
                    middle = x + front / 2
                    if rng.random() < 0.85 and np.abs(middle - crossing).min() > front / 2 + half + 1:
                        y = line + side * (half + rng.uniform(2, 6) + depth)
                        for solid in house(front, depth, height, side, rng):
                            put(scene, middle, y, turned, solid)
                    x += front + rng.choice([0, rng.uniform(1, 12)])
                for x in rng.uniform(0, size, int(size / 14)):  # cars, poles, trees
                    if np.abs(x - crossing).min() > half + 3:
                        for solid in thing(rng):
                            put(scene, x, line + side * (half - rng.uniform(0.5, 1.5)), turned, solid)
    maps = np.array(scene.maps)
    return np.array(scene.kinds), maps, maps[:, :2, 3]


def house(front: float, depth: float, height: float, side: int, rng: np.random.Generator) -> list[Solid]:
    """Kind, centre from the house's middle, half sizes: the house, its bays, balconies and steps."""
    found: list[Solid] = [(CUBE, [0, 0, height], [front / 2, depth, height])]
    for _ in range(rng.integers(1, 7)):
        at = [rng.uniform(-0.5, 0.5) * front, -side * depth, rng.uniform(0, 1.7 * height)]
        found.append((CUBE, at, rng.uniform(0.2, 1.3, 3)))
    return found


def thing(rng: np.random.Generator) -> list[Solid]:
    """A car, a pole or a tree."""
    kind, tall = rng.random(), rng.uniform(1, 4)
    if kind < 0.4:
        return [(CUBE, [0, 0, 0.7], [rng.uniform(1.8, 2.4), 0.85, 0.45]), (CUBE, [-0.2, 0, 1.3], [1.1, 0.75, 0.3])]
    found: list[Solid] = [(CYLINDER, [0, 0, tall], [rng.uniform(0.05, 0.2)] * 2 + [tall])]
    if kind > 0.6:
        found += [
            (BALL, rng.normal([0, 0, 2 * tall], 0.7), rng.uniform(0.5, 1.6, 3)) for _ in range(rng.integers(1, 4))
        ]
    return found


def put(scene: Scene, x: float, y: float, turned: float, solid: Solid) -> None:
    """Adds a solid of something at x along a street and y across, the street turned about z."""
    kind, offset, half = solid
    at, turn = np.asarray(offset), Rotation.from_euler("z", turned)
    # A street along y has its x along y, and its y along x; a quarter turn of (x, -y) is (y, x).
    place = np.array([x + at[0], y + at[1], at[2]])
    scene.add(kind, place if not turned else [place[1], place[0], place[2]], half, turn)


def revolution(
    solids: tuple[np.ndarray, ...], place: np.ndarray, beams: int, columns: int, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """One scan (n, 3) at place (2,), town's frame; only the solids in reach are asked."""
    kinds, maps, places = solids
    near = np.linalg.norm(places - place, axis=1) < REACH + 15
    scene = Scene(kinds[near].tolist(), list(maps[near]))
    scene.add(CUBE, [*place, -1], [2 * REACH, 2 * REACH, 1])
    eye = np.array([*place, EYE])
    rays = lidar_rays(Rotation.from_euler("zyx", [rng.uniform(0, 6.3), *rng.normal(0, 0.01, 2)]), beams, columns)
    points = scenes.scan(scene, eye, rays, rng, 0.0, REACH)
    away = points - eye
    return points + away / np.linalg.norm(away, axis=1, keepdims=True) * rng.normal(0, noise, (len(points), 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=float, default=500.0, help="metres")
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    across, along = streets(args.size, rng), streets(args.size, rng)
    solids = town(args.size, across, along, rng)
    steps = np.arange(EVERY / 2, args.size, EVERY)
    places = [[x, y] for y in across for x in steps] + [[x, y] for x in along for y in steps]
    seen = [revolution(solids, np.array(place), 32, 900, 0.0, rng) for place in places]
    whole = prepare(PointCloud(voxel_downsample(np.concatenate(seen), GRID)))
    console.print(f"{len(solids[0]):,} solids, a map of {whole.read:,} points from {len(places)} places")
    right, sure, wrong, seconds = 0, 0, 0, []
    for number in range(args.scans):
        street, at = rng.integers(len(across) + len(along)), rng.uniform(0.05, 0.95) * args.size
        place = [at, across[street]] if street < len(across) else [along[street - len(across)], at]
        points = revolution(solids, np.array(place) + rng.normal(0, 1, 2), 32, 600, NOISE, rng)
        T = random_pose(rng, None, 1.0)
        T[:3, 3] -= T[:3, :3] @ points.mean(0)
        begin = time.perf_counter()
        found = align(PointCloud(transform_points(T, points)), whole, Options(), CORES)
        seconds.append(time.perf_counter() - begin)
        degrees, shift = pose_error(found.T_target_source, np.linalg.inv(T), transform_points(T, points).mean(0))
        good, aligned = bool(degrees < DEGREES and shift < SHIFT), found.status == "aligned"
        right, sure, wrong = right + good, sure + (good and aligned), wrong + (aligned and not good)
        console.print(
            f"{number}: {degrees:.2f} deg, {shift:.2f} m, {found.status} {found.confidence:.2f}, {seconds[-1]:.1f} s"
        )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    console.print(
        f"{right} of {args.scans} right, {sure} of them aligned; {wrong} wrong and aligned; "
        f"median {np.median(seconds):.1f} s a scan; peak memory {memory:.0f} MiB with the making of the map"
    )


if __name__ == "__main__":
    main()
