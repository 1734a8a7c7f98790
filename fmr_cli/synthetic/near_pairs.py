"""Pairs that start near their pose, with exact normals: what noise, thinning and outliers do to a last step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.point_to_plane import linearise
from fmr_cli.geometry.sampling import sample
from fmr_cli.synthetic import scenes, sensors

START_DEGREES, START_SHIFT = 3.0, 0.02  # of the start, at most; of the size
SEEN_BY_BOTH = 2.0  # spacings of the target, within which a point of the source counts as seen by both
DETERMINED = 1e-4  # of the most information about a direction, the least: a pair whose pose nothing tells is no test
BOX = 1.1  # times the cloud's bounding box: where outliers are


@dataclass(frozen=True)
class TwoSamples:
    """One surface sampled twice, without noise, in one frame.

    source (N, 3), target (M, 3); normals (N, 3) of the source's points.
    """

    source: np.ndarray
    target: np.ndarray
    normals: np.ndarray

    @property
    def size(self) -> float:
        """The largest extent."""
        return float(np.ptp(self.target, axis=0).max())

    @property
    def common(self) -> np.ndarray:
        """Which of the source's points both saw: (N,)."""
        tree = cKDTree(self.target)
        reach = SEEN_BY_BOTH * float(np.median(tree.query(self.target[::10], 2)[0][:, 1]))
        return np.isfinite(tree.query(self.source, distance_upper_bound=reach)[0])

    @property
    def determined(self) -> bool:
        """Whether what both saw determines a pose in all directions."""
        common = self.common
        if not common.any():
            return False
        points = self.source[common] / self.size
        _, J = linearise(points, points, self.normals[common], points.mean(0))
        least, *_, most = np.linalg.eigvalsh(J @ J.T)
        return bool(least > DETERMINED * most)


@dataclass(frozen=True)
class Degraded:
    """What is done to two samples.

    noise, target_noise: standard deviations as shares of half the size, target_noise as noise where None; density:
    share of the points that the source keeps; outliers: share of each cloud's points that lie anywhere.
    """

    noise: float = 0.0
    target_noise: float | None = None
    density: float = 1.0
    outliers: float = 0.0


@dataclass(frozen=True)
class NearPair:
    """source (N, 3), target (M, 3), the pose and one near it; size: the largest extent.

    common, normals (K, 3): where those of the source's points that are no outliers and that both saw truly lie, in the
    target's frame, and the normals there; variance: of the distance between two noisy samples, own unit squared, see
    ``evaluation.cramer_rao``.
    """

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    start: np.ndarray
    size: float
    common: np.ndarray
    normals: np.ndarray
    variance: float


def halves(points: np.ndarray, normals: np.ndarray, count: int, rng: np.random.Generator) -> TwoSamples:
    """Two samples of at most ``count`` from points and their normals (N, 3), none in both."""
    order = rng.permutation(len(points))[: 2 * count]
    return TwoSamples(points[order[::2]], points[order[1::2]], normals[order[::2]])


def made_up(rng: np.random.Generator, count: int) -> TwoSamples:
    """A furnished room or a free-standing object, by a depth camera that moves about; exact normals."""
    if rng.random() < 0.5:
        scene, eye, towards = in_a_room(rng)
        points = sensors.camera_scan(scene, rng, eye, towards, 6.0, views=6, width=128, wander=0.7).points
    else:
        scene = scenes.thing(rng)
        points = sensors.object_scan(scene, rng, sensors.all_round(8, rng), 128).points
    return halves(points, scene.normals(points), count, rng)


def two_sensors(rng: np.random.Generator, count: int) -> TwoSamples:
    """A room or an object by a depth camera (source) and by a laser scanner on a tripod (target); exact normals."""
    if rng.random() < 0.5:
        scene, eye, towards = in_a_room(rng)
        camera = sensors.camera_scan(scene, rng, eye, towards, 6.0, views=6, wander=0.7)
        laser = sensors.terrestrial_scan(scene, rng, eye + rng.normal(0, 0.2, 3), 20.0, columns=360)
    else:
        scene = scenes.thing(rng)
        around = rng.uniform(0, 2 * np.pi) + np.pi / 2 * np.arange(4)
        stands = np.column_stack([np.cos(around), np.sin(around), np.full(4, 0.3)])
        camera = sensors.object_scan(scene, rng, sensors.all_round(6, rng), 96)
        laser = sensors.object_scan(scene, rng, stands, 160)
    source = sample(camera.points, count, rng)
    return TwoSamples(source, sample(laser.points, 4 * count, rng), scene.normals(source))


def in_a_room(rng: np.random.Generator) -> tuple[scenes.Scene, np.ndarray, np.ndarray]:
    """A room, where a sensor stands (3,) and where it looks (3,)."""
    heading = rng.uniform(0, 2 * np.pi)
    towards = np.array([np.cos(heading), np.sin(heading), -0.25])
    return scenes.room(rng), np.array([*rng.normal(0, 0.5, 2), 1.5]), towards


def near_pair(samples: TwoSamples, how: Degraded, rng: np.random.Generator) -> NearPair:
    """The samples degraded, the source in a frame of its own, and a start within START_DEGREES and START_SHIFT."""
    size, target_noise = samples.size, how.noise if how.target_noise is None else how.target_noise
    sigma_s, sigma_t = how.noise * size / 2, target_noise * size / 2
    keep = rng.permutation(len(samples.source))[: max(round(how.density * len(samples.source)), 10)]
    true = samples.source[keep]
    inliers = len(true) - round(how.outliers * len(true))
    source = with_outliers(true + rng.normal(0, sigma_s, true.shape), how.outliers, rng)
    target = with_outliers(samples.target + rng.normal(0, sigma_t, samples.target.shape), how.outliers, rng)
    centre = samples.target.mean(0)
    T = rigid(Rotation.random(random_state=rng), rng.normal(0, size, 3))
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.radians(rng.uniform(0, START_DEGREES)) * axis)
    off = rigid(turn, centre - turn.apply(centre) + way * rng.uniform(0, START_SHIFT * size))
    common = samples.common[keep][:inliers]
    ratio = inliers / ((1 - how.outliers) * len(samples.target))
    return NearPair(
        transform_points(np.linalg.inv(T), source), target, T, off @ T, size, true[:inliers][common],
        samples.normals[keep][:inliers][common], sigma_s**2 + sigma_t**2 * ratio,
    )  # fmt: skip


def with_outliers(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """The points (N, 3) with the last ``share`` of them anywhere in a box about them."""
    count = round(share * len(points))
    low, high = points.min(0), points.max(0)
    middle, half = (low + high) / 2, BOX * (high - low) / 2
    return np.concatenate([points[: len(points) - count], middle + half * rng.uniform(-1, 1, (count, 3))])


def rigid(turn: Rotation, shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), shift
    return T
