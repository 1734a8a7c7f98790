"""Pairs of scans with points that are no surface: no-returns, outliers, sky, the sensor's own vehicle, people."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fmr_cli.synthetic import scenes, sensors
from fmr_cli.synthetic.contradicting import room, room_scans
from fmr_cli.synthetic.draft import Draft, check_points, once
from fmr_cli.synthetic.scenes import FAR, Scene
from fmr_cli.synthetic.sensors import Scan


def street_scans(rng: np.random.Generator, reach: float) -> tuple[Scene, Scan, Scan]:
    """A street and two LiDAR scans of it, 1 to 8 m apart."""
    scene = scenes.street(rng, 100.0)
    beams, columns = int(rng.choice([32, 64])), int(rng.integers(360, 700))
    place = np.array([rng.uniform(-15, 15), rng.uniform(-1.5, 1.5), rng.uniform(1.6, 2.2)])
    ahead = np.array([rng.choice([-1, 1]) * rng.uniform(1, 8), rng.uniform(-0.5, 0.5), 0])
    scans = [sensors.lidar_scan(scene, rng, at, reach, beams, columns) for at in (place, place + ahead)]
    check_points(*scans)
    return scene, scans[0], scans[1]


def sky(rng: np.random.Generator, count: int, steepest: float = 25) -> np.ndarray:
    """Unit directions (count, 3), level up to ``steepest`` degrees, on the rings of a LiDAR."""
    elevation = np.radians(rng.choice(np.linspace(0, steepest, 24), count))
    azimuth, flat = rng.uniform(0, 2 * np.pi, count), np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], 1)


def on_street(stray: Callable[..., np.ndarray]) -> Callable[[np.random.Generator], Draft]:
    """A maker of pairs of street scans with ``stray(scene, scan, rng, reach, way)`` in each; way is the pair's own."""

    def make(rng: np.random.Generator) -> Draft:
        reach, way = rng.uniform(30, 90), int(rng.integers(1 << 31))
        scene, *scans = street_scans(rng, reach)
        for scan in scans:
            scan.stray = stray(scene, scan, rng, reach, np.random.default_rng(way))
        return Draft(scans[0], scans[1], once(), unique=True)

    return make


def max_range(scene: Scene, scan: Scan, rng: np.random.Generator, reach: float, way: np.random.Generator) -> np.ndarray:
    """Rays that meet nothing, written as points at the largest range."""
    assert scan.origin is not None
    rays = sky(rng, int(way.uniform(0.1, 0.9) * len(scan.points)), way.uniform(5, 60))
    return scan.origin + reach * rays[scene.cast(scan.origin, rays) > min(reach, FAR)]


def at_origin(scene: Scene, scan: Scan, rng: np.random.Generator, reach: float, way: np.random.Generator) -> np.ndarray:
    """Rays that meet nothing, written as zeros."""
    assert scan.origin is not None
    return np.tile(scan.origin, (int(way.uniform(0.02, 0.6) * len(scan.points)), 1))


def dust(scene: Scene, scan: Scan, rng: np.random.Generator, reach: float, way: np.random.Generator) -> np.ndarray:
    """Rain, birds and reflections between the sensor and the sky."""
    assert scan.origin is not None
    rays = sky(rng, int(way.uniform(0.02, 0.2) * len(scan.points)), way.uniform(30, 80))
    free = np.minimum(scene.cast(scan.origin, rays), reach)
    return scan.origin + rays * (free * rng.uniform(0.02, 1, len(rays)) ** way.uniform(0.7, 2))[:, None]


def vehicle(scene: Scene, scan: Scan, rng: np.random.Generator, reach: float, way: np.random.Generator) -> np.ndarray:
    """Roof, bonnet and racks of the car that carries the sensor: the same in every scan, in the sensor's frame."""
    assert scan.origin is not None
    car = Scene()
    car.add(scenes.CUBE, [-0.3, 0, -way.uniform(0.3, 0.6)], [way.uniform(0.8, 1.6), 0.8, 0.05])
    car.add(scenes.CUBE, [way.uniform(1.2, 2.0), 0, -0.9], [0.6, 0.75, 0.1])
    for _ in range(way.integers(1, 5)):
        car.add(int(way.integers(3)), way.uniform([-1.2, -0.7, -0.3], [0.8, 0.7, 0.1]), way.uniform(0.04, 0.25, 3))
    share = way.uniform(0.05, 0.45)
    body = sensors.surface_scan(car, rng, share * len(scan.points) / 12)
    return body.points + scan.origin


def outliers(points: int) -> Callable[..., np.ndarray]:
    """A few points far away, by ``points`` at most."""

    def stray(scene: Scene, scan: Scan, rng: np.random.Generator, reach: float, way: np.random.Generator) -> np.ndarray:
        assert scan.origin is not None
        count = int(rng.integers(1, points + 1))
        far = 10 ** rng.uniform(3, 6, (count, 1))
        if rng.random() < 0.1:
            far[0] = 1e20
        rays = rng.normal(size=(count, 3))
        return scan.origin + far * rays / np.linalg.norm(rays, axis=1, keepdims=True)

    return stray


def people(rng: np.random.Generator) -> Draft:
    """A room in which three to eight people stand in one scan only."""
    s = room(rng)
    scans = room_scans(s, s, rng)
    crowd, half = Scene(), np.diag(s.scene.maps[0])
    for x, y in rng.uniform(-0.9, 0.9, (int(rng.integers(3, 9)), 2)) * half[:2]:
        tall = rng.uniform(1.5, 1.95)
        crowd.add(scenes.CYLINDER, [x, y, 0.42 * tall], [rng.uniform(0.15, 0.25), rng.uniform(0.2, 0.3), 0.42 * tall])
        crowd.add(scenes.BALL, [x, y, 0.92 * tall], [0.1, 0.1, 0.13])
    share = rng.uniform(0.05, 0.25) * len(scans[0].points)
    scans[0].stray = sensors.surface_scan(crowd, rng, share / (2 * len(crowd.kinds))).points
    return Draft(scans[0], scans[1], once(), unique=True)


def nothing_else(rng: np.random.Generator) -> Draft:
    """Two scans in which no ray met anything: all points lie at the largest range, or nearly all."""
    reach, scans = rng.uniform(20, 120), []
    for _ in range(2):
        rays = sky(rng, int(rng.integers(2000, 20_000)), 60)
        scans.append(Scan(reach * rays, np.zeros(3)))
    return Draft(scans[0], scans[1], [], unique=False)


MAKERS: dict[str, Callable[[np.random.Generator], Draft]] = {
    "no-returns at maximum range": on_street(max_range),
    "no-returns at the origin": on_street(at_origin),
    "far outliers": on_street(outliers(20)),
    "sky": on_street(dust),
    "the sensor's own vehicle": on_street(vehicle),
    "people in one scan": people,
    "nothing but no-returns": nothing_else,
}
