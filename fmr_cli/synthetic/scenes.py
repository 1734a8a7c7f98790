"""Procedural rooms, streets and objects, and the scans that a depth camera or a spinning LiDAR would take of them.

Nothing here comes from a real scan: what is trained or calibrated on these scenes is judged on real ones unseen.
A scene is a list of unit solids (cube, ball, cylinder; half extent 1) under affine maps, and a scan casts rays at them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

CUBE, BALL, CYLINDER = 0, 1, 2  # kinds of solids
FAR = 1e9  # m: a ray that hits nothing


@dataclass
class Scene:
    """kinds: of each solid; maps: (M, 4, 4), unit solid to world, metres, z up."""

    kinds: list[int] = field(default_factory=list)
    maps: list[np.ndarray] = field(default_factory=list)

    def add(self, kind: int, centre: ArrayLike, half: ArrayLike, rotation: Rotation | None = None) -> None:
        """A solid of half extents ``half`` (3,) at ``centre`` (3,), turned by ``rotation``."""
        A = np.eye(4)
        A[:3, :3] = (np.eye(3) if rotation is None else rotation.as_matrix()) * np.asarray(half, float)
        A[:3, 3] = centre
        self.kinds.append(kind)
        self.maps.append(A)

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance along each unit direction (N, 3) to the first surface seen from origin (3,), or FAR."""
        nearest = np.full(len(directions), FAR)
        for kind, A in zip(self.kinds, self.maps, strict=True):
            # Only rays that meet the solid's bounding sphere are worth the exact test.
            towards, radius2 = A[:3, 3] - origin, (A[:3, :3] ** 2).sum()
            along = directions @ towards
            rays = np.flatnonzero(
                (along > 0) & (along**2 > towards @ towards - radius2) | (towards @ towards < radius2)
            )
            inverse = np.linalg.inv(A)
            o, d = inverse[:3, :3] @ origin + inverse[:3, 3], directions[rays] @ inverse[:3, :3].T
            nearest[rays] = np.minimum(nearest[rays], _HIT[kind](o, d))
        return nearest

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Exact unit normals (N, 3), outward of the solid, of the surfaces that points (N, 3) lie on."""
        nearest, found = np.full(len(points), FAR), np.zeros(points.shape)
        for kind, A in zip(self.kinds, self.maps, strict=True):
            inverse = np.linalg.inv(A)
            level, slope = _LEVEL[kind](points @ inverse[:3, :3].T + inverse[:3, 3])
            normal = slope @ inverse[:3, :3]
            length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
            closer = np.abs(level) / length < nearest
            nearest[closer] = (np.abs(level) / length)[closer]
            found[closer] = (normal / length[:, None])[closer]
        return found


# Of points (N, 3) in a unit solid's frame: a function that is 0 on its surface (N,), and its slope (N, 3).


def _level_cube(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows, axis = np.arange(len(u)), np.abs(u).argmax(1)
    slope = np.zeros(u.shape)
    slope[rows, axis] = np.sign(u[rows, axis])
    return np.abs(u)[rows, axis] - 1, slope


def _level_ball(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    radius = np.maximum(np.linalg.norm(u, axis=1), 1e-300)
    return radius - 1, u / radius[:, None]


def _level_cylinder(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    radius = np.maximum(np.linalg.norm(u[:, :2], axis=1), 1e-300)
    cap = np.abs(u[:, 2]) > radius
    wall = np.column_stack([u[:, :2] / radius[:, None], np.zeros(len(u))])
    return np.where(cap, np.abs(u[:, 2]), radius) - 1, np.where(cap[:, None], np.sign(u) * [0, 0, 1], wall)


_LEVEL = {CUBE: _level_cube, BALL: _level_ball, CYLINDER: _level_cylinder}


def _slabs(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-1 - o) / d, (1 - o) / d
    return np.minimum(a, b), np.maximum(a, b)


def _first(enter: np.ndarray, leave: np.ndarray) -> np.ndarray:
    """The wall in front: the entry, or the exit where the ray starts inside (a room is a cube seen from within)."""
    t = np.where(enter > 1e-6, enter, leave)
    return np.where((leave >= enter) & (t > 1e-6), t, FAR)


def _hit_cube(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    enter, leave = _slabs(o, d)
    return _first(np.nanmax(enter, 1), np.nanmin(leave, 1))


def _quadratic(a: np.ndarray, b: np.ndarray, c: float) -> tuple[np.ndarray, np.ndarray]:
    root = b * b - a * c
    s = np.sqrt(np.maximum(root, 0))
    a = np.maximum(a, 1e-12)
    return np.where(root > 0, (-b - s) / a, FAR), np.where(root > 0, (-b + s) / a, -FAR)


def _hit_ball(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    return _first(*_quadratic((d * d).sum(1), d @ o, float(o @ o) - 1))


def _hit_cylinder(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    enter, leave = _quadratic((d[:, :2] ** 2).sum(1), d[:, :2] @ o[:2], float(o[:2] @ o[:2]) - 1)
    low, high = _slabs(o[2:], d[:, 2:])
    return _first(np.maximum(enter, low[:, 0]), np.minimum(leave, high[:, 0]))


_HIT = {CUBE: _hit_cube, BALL: _hit_ball, CYLINDER: _hit_cylinder}


def _yaw(rng: np.random.Generator, tilt: float = 0.0) -> Rotation:
    return Rotation.from_euler("zyx", [rng.uniform(0, 2 * np.pi), *rng.normal(0, tilt, 2)])


def room(rng: np.random.Generator) -> Scene:
    """A room of 3 to 8 m with cupboards, tables, chairs and things on them; or a corridor. The floor is z = 0."""
    scene = Scene()
    size = np.array([rng.uniform(3, 8), rng.uniform(2, 7), rng.uniform(2.3, 3.2)])
    scene.add(CUBE, size * [0, 0, 0.5], size / 2)
    for _ in range(rng.integers(6, 16)):  # along the walls: cupboards, pillars, door frames
        half = np.array([rng.uniform(0.1, 0.9), rng.uniform(0.03, 0.35), rng.uniform(0.1, 1.1)])
        side, sign = rng.integers(2), rng.choice([-1, 1])
        place = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1)]) * size[:2] / 2
        place[side] = sign * (size[side] / 2 - half[1])
        z = half[2] if rng.random() < 0.6 else rng.uniform(half[2], size[2] - half[2])
        turned = Rotation.from_euler("z", 90 * (1 - side), degrees=True)
        scene.add(CUBE, [*place, z], half, turned)
    for _ in range(rng.integers(2, 6)):  # tables with legs and clutter
        half = np.array([rng.uniform(0.3, 0.9), rng.uniform(0.25, 0.5), 0.02])
        height, turn = rng.uniform(0.4, 0.9), _yaw(rng)
        place = np.append(rng.uniform(-0.4, 0.4, 2) * size[:2], height)
        scene.add(CUBE, place, half, turn)
        for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            foot = place + turn.apply([0.9 * x * half[0], 0.9 * y * half[1], -height / 2])
            scene.add(CUBE, foot, [0.03, 0.03, height / 2], turn)
        for _ in range(rng.integers(1, 8)):
            thing = rng.uniform(0.03, 0.2, 3)
            on = place + turn.apply([*(rng.uniform(-0.9, 0.9, 2) * half[:2]), thing[2]])
            scene.add(int(rng.integers(3)), on, thing, _yaw(rng, 0.05))
    for _ in range(rng.integers(4, 14)):  # chairs, bins, lamps, bags: leaning at any angle
        half = rng.uniform(0.08, 0.45, 3)
        place = np.append(rng.uniform(-0.45, 0.45, 2) * size[:2], half[2])
        scene.add(int(rng.integers(3)), place, half, _yaw(rng, 0.3))
    return scene


def street(rng: np.random.Generator, length: float = 160.0) -> Scene:
    """A street along x: ground, kerbs, houses with recesses, cars, poles, trees and hedges."""
    scene = Scene()
    scene.add(CUBE, [0, 0, -1], [length, length, 1], Rotation.from_euler("xy", rng.normal(0, 0.01, 2)))
    width = rng.uniform(6, 15)
    for side in (-1, 1):
        scene.add(CUBE, [0, side * (width / 2 + 2), -0.05], [length, 2, 0.2])
        x = -length / 2
        while x < length / 2:
            front, depth, height = rng.uniform(4, 20), rng.uniform(3, 8), rng.uniform(1.5, 7)
            y = side * (width / 2 + rng.uniform(2, 7) + depth)
            turn = Rotation.from_euler("z", rng.normal(0, 0.08))
            if rng.random() < 0.8:
                scene.add(CUBE, [x + front / 2, y, height], [front / 2, depth, height], turn)
                for _ in range(rng.integers(0, 5)):  # doors, bays, balconies
                    at = [x + rng.uniform(0, front), y - side * depth, rng.uniform(0, 1.6 * height)]
                    scene.add(CUBE, at, rng.uniform(0.2, 1.2, 3), turn)
            x += front + rng.choice([0, rng.uniform(1, 12)])
    for _ in range(rng.integers(10, 30)):  # cars
        place = [rng.uniform(-length / 2, length / 2), rng.choice([-1, 1]) * width / 2 * rng.uniform(0.6, 1), 0.7]
        turn = Rotation.from_euler("z", rng.normal(0, 0.1) + (np.pi / 2 if rng.random() < 0.1 else 0))
        scene.add(CUBE, place, [rng.uniform(1.8, 2.4), 0.85, 0.45], turn)
        scene.add(CUBE, [place[0] - 0.2, place[1], 1.3], [1.1, 0.75, 0.3], turn)
    for _ in range(rng.integers(15, 50)):  # poles and trees
        x, y = rng.uniform(-length / 2, length / 2), rng.choice([-1, 1]) * (width / 2 + rng.uniform(0.5, 12))
        tall = rng.uniform(1, 4)
        scene.add(CYLINDER, [x, y, tall], [0.05 + 0.2 * rng.random() ** 2, 0.05 + 0.2 * rng.random() ** 2, tall])
        if rng.random() < 0.6:
            for _ in range(rng.integers(1, 5)):
                scene.add(BALL, rng.normal([x, y, 2 * tall], 0.8), rng.uniform(0.4, 1.6, 3), _yaw(rng, 0.3))
    return scene


def thing(rng: np.random.Generator) -> Scene:
    """A free-standing object of about 1 m: two to nine solids that touch, at any angle."""
    scene, centre = Scene(), np.zeros(3)
    for _ in range(rng.integers(2, 10)):
        half = np.exp(rng.uniform(np.log(0.06), np.log(0.45), 3))
        scene.add(int(rng.integers(3)), centre, half, Rotation.random(random_state=rng))
        centre = centre + Rotation.random(random_state=rng).apply([half.max() * rng.uniform(0.5, 1), 0, 0])
        centre *= 0.8
    return scene


def camera_rays(rotation: Rotation, width: int = 128, height: int = 96, fov: float = 58.0) -> np.ndarray:
    """Unit directions (width * height, 3) of a depth camera that looks along its x axis, z up."""
    half = np.tan(np.radians(fov / 2))
    y, z = np.meshgrid(np.linspace(-half, half, width), np.linspace(-half, half, height) * height / width)
    rays = np.stack([np.ones_like(y), y, z], -1).reshape(-1, 3)
    return rotation.apply(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def lidar_rays(rotation: Rotation, beams: int = 64, columns: int = 900) -> np.ndarray:
    """Unit directions (beams * columns, 3) of a spinning scanner, from 3 deg above the horizon to 25 below."""
    azimuth, elevation = np.meshgrid(np.linspace(0, 2 * np.pi, columns, False), np.radians(np.linspace(3, -25, beams)))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    return rotation.apply(rays.reshape(-1, 3))


def scan(
    scene: Scene, origin: np.ndarray, rays: np.ndarray, rng: np.random.Generator, noise: float, reach: float
) -> np.ndarray:
    """World points (n, 3) that the rays from origin hit within reach; Gaussian range noise, 2 % of them lost."""
    distance = scene.cast(origin, rays)
    seen = (distance < reach) & (rng.random(len(rays)) > 0.02)
    distance = distance[seen] * (1 + rng.normal(0, noise, seen.sum()))
    return origin + rays[seen] * distance[:, None]


def room_scan(scene: Scene, rng: np.random.Generator, eye: np.ndarray, heading: float, views: int = 5) -> np.ndarray:
    """A fragment: depth camera views from a short walk about eye (3,), looking about heading (rad), fused."""
    parts = []
    for _ in range(views):
        heading += rng.normal(0, 0.35)
        look = Rotation.from_euler("zy", [heading, rng.normal(0.25, 0.2)])
        place = eye + rng.normal(0, 0.15, 3)
        parts.append(scan(scene, place, camera_rays(look), rng, rng.uniform(0.001, 0.004), 5.0))
    return np.concatenate(parts)


def street_scan(scene: Scene, rng: np.random.Generator, place: np.ndarray, heading: float = 0.0) -> np.ndarray:
    """One revolution of a LiDAR at place (3,), world frame."""
    rays = lidar_rays(Rotation.from_euler("zyx", [heading, *rng.normal(0, 0.01, 2)]))
    return scan(scene, place, rays, rng, 0.0005, 80.0)


def thing_scan(scene: Scene, rng: np.random.Generator, towards: np.ndarray, views: int) -> np.ndarray:
    """An object seen from ``views`` sides about the direction ``towards`` (3,), fused."""
    parts = []
    for _ in range(views):
        d = towards / np.linalg.norm(towards) + rng.normal(0, 0.6, 3) * (views > 1)
        d /= np.linalg.norm(d)
        look = Rotation.align_vectors(-d[None], np.array([[1.0, 0, 0]]))[0]
        parts.append(scan(scene, 4 * d, camera_rays(look, 160, 160, 40), rng, 0.0005, 10.0))
    return np.concatenate(parts)
