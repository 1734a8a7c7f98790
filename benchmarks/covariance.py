"""Is the covariance true? The error of right poses against it (NEES), on made-up pairs whose truth is exact.

    python -m benchmarks.covariance --pairs 20

resample, noise, overlap70: the paper's protocols, on rooms and objects. lidar: two revolutions in a street, 4 to 12 m
apart, with 5 to 20 mm of noise on each range; depth: two views of a room, with 2 to 12 mm. Each scan has a bias of half
as much besides, and says where its sensor was, as their files do. Said: the median of the NEES, 5.35 expected over six
directions; the share of poses within the ellipsoids that should hold half and 95 % of them; how many were right.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.common import console, make_pair, random_pose, room_clouds, shape_clouds, show
from fmr_cli.cloud import PointCloud
from fmr_cli.evaluation.verdict import nees
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.registration.pipeline import align
from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.contradicting import free_place
from fmr_cli.synthetic.scenes import Scene, camera_rays, lidar_rays

SAMPLED = ("resample", "noise", "overlap70")
POINTS = 12_288
DEGREES, SHARE = 5.0, 0.05  # a pose further off, deg and share of the target's extent, is wrong: no covariance is asked


def biased(
    scene: Scene, eye: np.ndarray, rays: np.ndarray, reach: float, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """What rays from eye (3,) hit: noise of each range and half as much of the scan, own unit."""
    points = scenes.scan(scene, eye, rays, rng, 0.0, reach)
    away = points - eye
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return points + away * (rng.normal(0, noise, (len(points), 1)) + rng.normal(0, noise / 2))


def lidar(rng: np.random.Generator) -> tuple[PointCloud, PointCloud]:
    """Two revolutions in a street, in one frame."""
    scene, noise = scenes.street(rng, 120.0), rng.uniform(0.005, 0.02)
    places = np.array([[0, 0, 1.9], [rng.uniform(4, 12), rng.uniform(-1, 1), 1.9]])
    turns = [Rotation.from_euler("zyx", [rng.uniform(0, 6.3), *rng.normal(0, 0.01, 2)]) for _ in places]
    source, target = (
        PointCloud(biased(scene, at, lidar_rays(turn, 32, 600), 60.0, noise, rng), sensor_origin=at)
        for at, turn in zip(places, turns, strict=True)
    )
    return source, target


def depth(rng: np.random.Generator) -> tuple[PointCloud, PointCloud]:
    """Two views of a room by a depth camera, in one frame."""
    scene, noise, heading = scenes.room(rng), rng.uniform(0.002, 0.012), rng.uniform(0, 6.3)
    eye, clouds = free_place(scene, rng), []
    for turned in (0.0, 0.4):
        look = Rotation.from_euler("zy", [heading + turned, 0.25])
        at = eye + rng.normal(0, 0.05, 3)
        clouds.append(PointCloud(biased(scene, at, camera_rays(look, 160, 120), 6.0, noise, rng), sensor_origin=at))
    return clouds[0], clouds[1]


def moved(pair: tuple[PointCloud, PointCloud], rng: np.random.Generator) -> tuple[PointCloud, PointCloud, np.ndarray]:
    """The pair with its target in a frame of its own, and T_target_source."""
    T = random_pose(rng, None, 1.0)
    return pair[0], pair[1].transformed(T), T


def sampled(protocol: str, points: np.ndarray, rng: np.random.Generator) -> tuple[PointCloud, PointCloud, np.ndarray]:
    """A pair of the paper's protocol, of no sensor."""
    source, target, T = make_pair(protocol, points, rng)
    return PointCloud(source), PointCloud(target), T


Maker = Callable[[int, np.random.Generator], tuple[PointCloud, PointCloud, np.ndarray]]


def makers(pairs: int, seed: int) -> dict[str, Maker]:
    """How a pair of each kind is made, by its number: source, target, T_target_source."""
    clouds = [c for both in zip(room_clouds(pairs // 2 + 1, POINTS, seed), shape_clouds(pairs // 2 + 1, POINTS, seed),
                                strict=True) for c in both]  # fmt: skip
    found: dict[str, Maker] = {
        protocol: lambda n, rng, protocol=protocol: sampled(protocol, clouds[n], rng)  # type: ignore[misc]
        for protocol in SAMPLED
    }
    return found | {"lidar": lambda n, rng: moved(lidar(rng), rng), "depth": lambda n, rng: moved(depth(rng), rng)}


def measure(kind: str, make: Maker, pairs: int, seed: int) -> dict[str, object]:
    """One row of the table: the kind's NEES over its right poses."""
    squared, probability = [], []
    for number in range(pairs):
        source, target, truth = make(number, np.random.default_rng((seed, number)))
        found = align(source, target)
        degrees, shift = pose_error(found.T_target_source, truth, source.points.mean(0))
        if degrees < DEGREES and shift < SHARE * np.ptp(target.points, axis=0).max():
            value, directions = nees(found, truth)
            squared.append(value)
            probability.append(chi2.cdf(value, directions))
    within = np.array(probability)
    return {
        "kind": kind, "right": f"{len(squared)}/{pairs}",
        "median NEES": float(np.median(squared)) if squared else float("nan"),
        "within 50 %": float((within < 0.5).mean()), "within 95 %": float((within < 0.95).mean()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=20, help="of each kind")
    parser.add_argument("--seed", type=int, default=50_000)
    args = parser.parse_args()
    rows = []
    for kind, make in makers(args.pairs, args.seed).items():
        rows.append(measure(kind, make, args.pairs, args.seed))
        console.print(rows[-1])
    show("normalised estimation error squared", rows)


if __name__ == "__main__":
    main()
