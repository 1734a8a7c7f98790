"""Made-up places, ways through them and scanners carried along, with exact truth: to measure `fmr sequence` by.

Lengths in metres, z up. A scanner that moves while it scans sees each part of a revolution from another place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud
from fmr_cli.synthetic.scenes import BALL, CUBE, CYLINDER, Scene, camera_rays

PARTS = 24  # of a revolution, each seen from one place: 15 deg, in which a car at 10 m/s and 10 Hz moves 4 cm
CLEARANCE = 0.2  # m, of what stands in a passage from the scanner's way, beyond its own size
LOST = 0.02  # share of the rays that give nothing


@dataclass(frozen=True)
class Sensor:
    """rays: (N, 3), unit, in the sensor's frame, x forward, in the order of their times (N,), 0 to 1 over a scan.

    reach and noise (standard deviation of a range): metres. sweep: seconds that a scan takes, 0: none.
    """

    rays: np.ndarray
    times: np.ndarray
    reach: float
    noise: float
    sweep: float = 0.0


def spinning(
    beams: int, low: float, high: float, columns: int, reach: float = 80.0, noise: float = 0.02, sweep: float = 0.0
) -> Sensor:
    """A spinning LiDAR, its beams even between two elevations, degrees."""
    azimuth, elevation = np.meshgrid(
        np.arange(columns) * 2 * np.pi / columns, np.radians(np.linspace(low, high, beams)), indexing="ij"
    )
    flat = np.cos(elevation)
    rays = np.stack([-flat * np.cos(azimuth), -flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    return Sensor(rays, (azimuth / (2 * np.pi)).ravel(), reach, noise, sweep)


def solid_state(points: int = 12_000, reach: float = 60.0, noise: float = 0.02, sweep: float = 0.0) -> Sensor:
    """A forward-looking LiDAR of 70 by 60 deg that draws a rosette."""
    t = np.linspace(0, 1, points, False)
    across = np.sin(2 * np.pi * 137.3 * t) * np.radians(35)
    up = np.sin(2 * np.pi * 97.1 * t + 0.3) * np.radians(30)
    rays = np.stack([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)], 1)
    return Sensor(rays, t, reach, noise, sweep)


def depth_camera(width: int = 128, reach: float = 6.0) -> Sensor:
    """A camera that sees all at one instant."""
    rays = camera_rays(Rotation.identity(), width, width * 3 // 4, 62.0)
    return Sensor(rays, np.full(len(rays), 0.5), reach, 0.005)


@dataclass(frozen=True)
class Way:
    """A smooth way through corners (n, 3), closed or not, at an even speed (m/s); its wobble in degrees."""

    corners: np.ndarray
    speed: float
    closed: bool = True
    wobble: float = 0.5
    phases: np.ndarray = field(default_factory=lambda: np.array([0.3, 1.7, 4.1]))

    def __post_init__(self) -> None:
        corners = np.asarray(self.corners, float)
        if self.closed:
            corners = np.vstack([corners, corners[:1]])
        rough = np.linspace(0, 1, len(corners))
        spline = CubicSpline(rough, corners, bc_type="periodic" if self.closed else "natural")
        fine = np.linspace(0, 1, 200 * len(corners))
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1))])
        object.__setattr__(self, "_spline", spline)
        object.__setattr__(self, "_fine", fine)
        object.__setattr__(self, "_along", along)

    @property
    def length(self) -> float:
        return float(self._along[-1])  # type: ignore[attr-defined]

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """T_world_sensor (n, 4, 4) at these times (n,)."""
        u = np.interp(seconds * self.speed, self._along, self._fine)  # type: ignore[attr-defined]
        spline = self._spline  # type: ignore[attr-defined]
        heading = spline(u, 1)
        yaw = np.arctan2(heading[:, 1], heading[:, 0])
        swing = np.radians(self.wobble) * np.sin(2 * np.pi * seconds[:, None] * [0.9, 0.5, 0.37] + self.phases)
        T = np.tile(np.eye(4), (len(seconds), 1, 1))
        T[:, :3, :3] = Rotation.from_euler("zyx", np.stack([yaw + swing[:, 2], *swing[:, :2].T], 1)).as_matrix()
        T[:, :3, 3] = spline(u)
        return T


@dataclass(frozen=True)
class Drive:
    """A sensor carried through a place: ``rate`` scans a second over ``laps`` of the way."""

    scene: Scene
    way: Way
    sensor: Sensor
    rate: float
    laps: float = 1.0
    seed: int = 0

    @property
    def seconds(self) -> np.ndarray:
        """(n,), of the scans' middles."""
        return np.arange(0.5 / self.rate, self.laps * self.way.length / self.way.speed, 1 / self.rate)

    def truth(self) -> np.ndarray:
        """(n, 4, 4): the sensor's frame at each scan's middle, to that of the first."""
        poses = self.way.poses(self.seconds % (self.way.length / self.way.speed))
        return np.linalg.inv(poses[0]) @ poses

    def scans(self) -> Iterator[PointCloud]:
        """Each scan in the sensor's own frames, with the points' ``time`` in seconds."""
        rng, sensor = np.random.default_rng(self.seed), self.sensor
        centres = np.array([A[:3, 3] for A in self.scene.maps])
        sizes = np.array([np.sqrt((A[:3, :3] ** 2).sum()) for A in self.scene.maps])
        parts = np.minimum((sensor.times * PARTS).astype(int), PARTS - 1) if sensor.sweep else np.zeros(1, int)
        lap = self.way.length / self.way.speed
        for middle in self.seconds:
            moments = middle + ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * sensor.sweep if sensor.sweep else [middle]
            found, times = [], []
            for part, T in enumerate(self.way.poses(np.asarray(moments) % lap)):
                mine = parts == part if sensor.sweep else np.ones(len(sensor.rays), bool)
                near = np.linalg.norm(centres - T[:3, 3], axis=1) < sizes + sensor.reach
                seen = Scene([k for k, n in zip(self.scene.kinds, near, strict=True) if n],
                             [A for A, n in zip(self.scene.maps, near, strict=True) if n])  # fmt: skip
                distance = seen.cast(T[:3, 3], sensor.rays[mine] @ T[:3, :3].T)
                hit = (distance < sensor.reach) & (rng.random(len(distance)) > LOST)
                found.append(sensor.rays[mine][hit] * (distance[hit] + rng.normal(0, sensor.noise, hit.sum()))[:, None])
                times.append(middle + (sensor.times[mine][hit] - 0.5) * sensor.sweep)
            yield PointCloud(np.concatenate(found), {"time": np.concatenate(times)})


def round_corners(
    size: tuple[float, float], every: float, rng: np.random.Generator, stray: float, z: float
) -> np.ndarray:
    """Corners of a way round a rectangle, ``every`` so far, each off it by up to ``stray``."""
    (a, b), corners = size, []
    for start, end in (((-a, -b), (a, -b)), ((a, -b), (a, b)), ((a, b), (-a, b)), ((-a, b), (-a, -b))):
        low, high = np.array(start) / 2, np.array(end) / 2
        count = max(int(np.linalg.norm(high - low) / every), 2)
        for step in (np.arange(count) + 0.5) / count:
            corners.append([*(low + step * (high - low) + rng.uniform(-stray, stray, 2)), z])
    return np.array(corners)


def tree(scene: Scene, x: float, y: float, rng: np.random.Generator) -> None:
    tall = rng.uniform(2, 4)
    scene.add(CYLINDER, [x, y, tall / 2], [*[rng.uniform(0.1, 0.3)] * 2, tall / 2])
    for _ in range(rng.integers(2, 4)):
        scene.add(BALL, rng.normal([x, y, tall + 1], 1.0), rng.uniform(0.5, 1.5, 3), Rotation.random(random_state=rng))


def streets(rng: np.random.Generator, a: float, b: float) -> tuple[Scene, np.ndarray]:
    """Houses, trees and parked cars on both sides of a round of streets, a by b."""
    scene = Scene()
    scene.add(CUBE, [0, 0, -1], [a, b, 1])
    for side in range(4):
        turned = Rotation.from_euler("z", 90 * side, degrees=True)
        along, across = (a, b) if side % 2 == 0 else (b, a)
        for offset, inner in ((-across / 2 - 9, False), (-across / 2 + 9, True)):
            x, end = -along / 2 + (10 if inner else -16), along / 2 - (10 if inner else -16)
            while x < end:
                front, depth, height = rng.uniform(5, 14), rng.uniform(3, 6), rng.uniform(2, 6)
                front = min(front, end - x)  # a last house that went on stood across the next street, on the way
                y = offset + (1 if inner else -1) * (depth + rng.uniform(0, 2))
                scene.add(CUBE, turned.apply([x + front / 2, y, height]), [front / 2, depth, height], turned)
                x += front + rng.uniform(0.5, 6)
        for x in np.arange(-along / 2 + 6, along / 2 - 6, 9.0):
            if rng.random() < 0.6:
                at = turned.apply([x, -across / 2 + rng.choice([-4.5, 4.5]), 0.75])
                scene.add(CUBE, at, [2.1, 0.9, 0.75], turned)
            if rng.random() < 0.5:
                at = turned.apply([x + rng.uniform(0, 5), -across / 2 + rng.choice([-6.5, 6.5]), 2.5])
                scene.add(CYLINDER, at, [0.1, 0.1, 2.5])
    return scene, round_corners((a, b), 15, rng, 0.4, 1.8)


def campus(rng: np.random.Generator, a: float, b: float) -> tuple[Scene, np.ndarray]:
    """Large buildings far apart, trees, hedges and lawns with low mounds between; a winding way."""
    scene = Scene()
    scene.add(CUBE, [0, 0, -1], [a + 100, b + 100, 1])
    corners = round_corners((a, b), 20, rng, 4.0, 1.2)

    def clear(x: float, y: float, size: float) -> bool:
        return bool(np.linalg.norm(corners[:, :2] - [x, y], axis=1).min() > size)

    for _ in range(int((a + 100) * (b + 100) / 160)):
        x, y = rng.uniform(-a / 2 - 60, a / 2 + 60), rng.uniform(-b / 2 - 60, b / 2 + 60)
        kind = rng.random()
        if kind < 0.1 and clear(x, y, 24):
            half = [rng.uniform(8, 20), rng.uniform(6, 14), rng.uniform(4, 9)]
            scene.add(CUBE, [x, y, half[2]], half, Rotation.from_euler("z", rng.uniform(0, 3)))
        elif kind < 0.8 and clear(x, y, 4):
            tree(scene, x, y, rng)
        elif kind < 0.9 and clear(x, y, 12):
            scene.add(BALL, [x, y, -0.5], [*rng.uniform(4, 12, 2), rng.uniform(0.8, 1.6)])
        elif clear(x, y, 6):
            scene.add(CUBE, [x, y, 0.5], [rng.uniform(2, 6), 0.5, 0.6], Rotation.from_euler("z", rng.uniform(0, 3)))
    return scene, corners


def passages(rng: np.random.Generator, a: float, b: float, width: float, rough: float) -> tuple[Scene, np.ndarray]:
    """A round of corridors (rough 0) with doors, pillars and cupboards, or of mine galleries with broken walls."""
    scene, height = Scene(), 1.4 if rough == 0 else 2.0
    scene.add(CUBE, [0, 0, -1], [a, b, 1])
    scene.add(CUBE, [0, 0, 2 * height + 1], [a, b, 1])
    scene.add(CUBE, [0, 0, height], [(a - width) / 2, (b - width) / 2, height + 0.1])
    scene.add(CUBE, [0, 0, height], [(a + width) / 2, (b + width) / 2, height + 0.1])  # seen from within
    things = []
    for side in range(4):
        turned = Rotation.from_euler("z", 90 * side, degrees=True)
        along, across = (a, b) if side % 2 == 0 else (b, a)
        x = -along / 2
        while x < along / 2:
            y = -across / 2 + rng.choice([-1, 1]) * width / 2
            if rough:
                at, half = [x, y, rng.uniform(0, 2 * height)], rng.uniform(0.2, rough, 3)
                things.append((turned.apply(at), half, Rotation.random(random_state=rng), np.linalg.norm(half)))
                x += rng.uniform(0.1, 0.5)
            else:
                half = np.array([rng.uniform(0.2, 0.6), rng.uniform(0.03, 0.25), rng.uniform(0.4, 1.2)])
                things.append((turned.apply([x, y, half[2]]), half, turned, np.linalg.norm(half[:2])))
                x += rng.uniform(1.5, 4)
    corners = round_corners((a, b), 4, rng, 0.1, 1.0)
    way = Way(corners, 1.0)
    passed = way.poses(np.arange(0, way.length, 0.2))[:, :2, 3]
    for at, half, turned, size in things:  # at a corner, what stands along one side may stand in the way of the next
        if np.linalg.norm(passed - at[:2], axis=1).min() > size + CLEARANCE:
            scene.add(CUBE, at, half, turned)
    return scene, corners


def warehouse(rng: np.random.Generator, a: float, b: float) -> tuple[Scene, np.ndarray]:
    """Aisles between racks that are all alike, 6 m apart; a way up one aisle, across and down the next."""
    scene = Scene()
    scene.add(CUBE, [0, 0, -1], [a, b, 1])
    scene.add(CUBE, [0, 0, 4], [a / 2 + 8, b / 2 + 8, 4.2])  # the hall, seen from within
    for y in np.arange(-b / 2, b / 2 + 0.1, 6.0):
        for x in np.arange(-a / 2, a / 2 + 0.1, 2.7):
            scene.add(CUBE, [x, y, 3], [0.06, 0.5, 3])
            if rng.random() < 0.6:
                level = rng.integers(0, 3)
                scene.add(CUBE, [x + 1.35, y, 2 * level + 0.7], [rng.uniform(0.4, 1.2), 0.45, rng.uniform(0.3, 0.7)])
        for z in (0.1, 2.1, 4.1):
            scene.add(CUBE, [0, y, z], [a / 2, 0.5, 0.05])
    corners, up = [], True
    for y in np.arange(-b / 2 + 3, b / 2, 6.0):
        ends = np.linspace(-a / 2 - 3, a / 2 + 3, max(int(a / 6), 4))
        corners += [[x, y, 1.5] for x in (ends if up else ends[::-1])]
        up = not up
    return scene, np.array(corners)
