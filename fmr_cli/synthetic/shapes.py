"""Procedural shapes: training data for the bundled encoder, which has never seen a real scan.

Each shape is a union of 2 to 7 boxes, spheres, cylinders, cones, tori and planes with random proportions, turned at
random or (every third shape) only about the vertical, as things that people build stand.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def _box(rng: np.random.Generator, n: int) -> np.ndarray:
    points = rng.uniform(-1, 1, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1.0, 1.0], n)
    return points


def _sphere(rng: np.random.Generator, n: int) -> np.ndarray:
    points = rng.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def _cylinder(rng: np.random.Generator, n: int) -> np.ndarray:
    angle, height = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1, 1, n)
    cap = rng.uniform(size=n) < 1 / 3  # two discs of area pi beside a wall of 4 pi
    radius = np.where(cap, np.sqrt(rng.uniform(size=n)), 1.0)
    height = np.where(cap, np.sign(height), height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)


def _cone(rng: np.random.Generator, n: int) -> np.ndarray:
    angle, radius = rng.uniform(0, 2 * np.pi, n), np.sqrt(rng.uniform(size=n))
    height = np.where(rng.uniform(size=n) < 0.3, -1.0, 1 - 2 * radius)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)


def _torus(rng: np.random.Generator, n: int) -> np.ndarray:
    u, v = rng.uniform(0, 2 * np.pi, (2, n))
    thickness = rng.uniform(0.1, 0.45)
    ring = 1 - thickness + thickness * np.cos(v)
    return np.stack([ring * np.cos(u), ring * np.sin(u), thickness * np.sin(v)], 1)


def _plane(rng: np.random.Generator, n: int) -> np.ndarray:
    points = rng.uniform(-1, 1, (n, 3))
    points[:, 2] = 0
    return points


PRIMITIVES = (_box, _sphere, _cylinder, _cone, _torus, _plane)


def shape(rng: np.random.Generator, points: int) -> np.ndarray:
    """One random shape, (points, 3) float64, in no particular pose or scale."""
    parts = rng.integers(2, 8)
    upright = rng.uniform() < 1 / 3
    scales = rng.uniform(0.15, 1.0, (parts, 1)) * rng.uniform(0.3, 1.0, (parts, 3))
    pairs = scales * np.roll(scales, 1, 1)
    shares = pairs.sum(1) / pairs.sum()  # near enough in proportion to the area
    counts = rng.multinomial(points, shares)
    spins = (
        Rotation.from_rotvec(rng.uniform(0, 2 * np.pi, (parts, 1)) * [0, 0, 1])
        if upright
        else Rotation.random(parts, rng)
    )
    centres = rng.uniform(-0.8, 0.8, (parts, 3))
    bodies = []
    for scale, count, spin, centre in zip(scales, counts, spins, centres, strict=True):
        primitive = PRIMITIVES[rng.integers(len(PRIMITIVES))]
        bodies.append(spin.apply(primitive(rng, count) * scale) + centre if count else np.empty((0, 3)))
    return np.concatenate(bodies)


def shapes(count: int, points: int, seed: int) -> np.ndarray:
    """(count, points, 3) float32 random shapes, each centred on its mean and scaled to a largest half extent of 0.5."""
    rng = np.random.default_rng(seed)
    return np.stack([_normalised(rng.permutation(shape(rng, points))) for _ in range(count)])


def _knot(rng: np.random.Generator, n: int) -> np.ndarray:
    p, q = rng.choice([(2, 3), (3, 2), (2, 5), (3, 4), (1, 4)])
    t, around = rng.uniform(0, 2 * np.pi, (2, n))
    r = 2 + np.cos(q * t)
    curve = np.stack([r * np.cos(p * t), r * np.sin(p * t), -np.sin(q * t)], 1)
    out = np.stack([np.cos(p * t), np.sin(p * t), np.zeros(n)], 1)
    tube = np.cos(around)[:, None] * out + np.sin(around)[:, None] * [0, 0, 1]
    return curve + rng.uniform(0.15, 0.4) * tube


def _blob(rng: np.random.Generator, n: int) -> np.ndarray:
    points = _sphere(rng, n)
    waves = rng.normal(0, 2.0, (6, 3))
    bumps = np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, 6)) @ rng.uniform(0.05, 0.2, 6)
    return points * (1 + bumps)[:, None] * rng.uniform(0.4, 1, 3)


def _terrain(rng: np.random.Generator, n: int) -> np.ndarray:
    ground = rng.uniform(-1, 1, (n, 2))
    waves = rng.normal(0, 3.0, (8, 2))
    height = np.sin(ground @ waves.T + rng.uniform(0, 2 * np.pi, 8)) @ rng.uniform(0.02, 0.12, 8)
    return np.column_stack([ground, height])


def _vase(rng: np.random.Generator, n: int) -> np.ndarray:
    height, angle = rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    radius = 0.5 + np.sin(height[:, None] * rng.uniform(1, 5, 3) + rng.uniform(0, 6, 3)) @ rng.uniform(0.02, 0.15, 3)
    body = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)
    handle = _torus(rng, n) @ np.array([[0.4, 0, 0], [0, 0, 0.4], [0, 0.4, 0]]) + [0.7, 0, rng.uniform(-0.3, 0.3)]
    return np.where(rng.uniform(size=(n, 1)) < 0.15, handle, body)


def _chair(rng: np.random.Generator, n: int) -> np.ndarray:
    w, d, h, back = rng.uniform([0.4, 0.4, 0.3, 0.3], [0.7, 0.7, 0.7, 0.9])
    seat = ([0, 0, 0], [w, d, 0.05])
    legs = [([x * (w - 0.05), y * (d - 0.05), -h], [0.05, 0.05, h]) for x in (-1, 1) for y in (-1, 1)]
    parts = [seat, ([0, d - 0.04, back], [w, 0.04, back]), *legs]
    which = rng.choice(len(parts), n, p=[0.35, 0.25, 0.1, 0.1, 0.1, 0.1])
    centres, sizes = (np.array([part[i] for part in parts]) for i in (0, 1))
    return _box(rng, n) * sizes[which] + centres[which]


def _room(rng: np.random.Generator, n: int) -> np.ndarray:
    size = rng.uniform([1, 1, 0.5], [2, 2, 1])
    seen = [(axis, -1.0) for axis in range(3)] + [(int(rng.integers(2)), 1.0)] * bool(rng.integers(2))
    axis, side = np.array(seen)[rng.integers(len(seen), size=n)].T
    walls = rng.uniform(-1, 1, (n, 3))
    walls[np.arange(n), axis.astype(int)] = side
    walls *= size
    chairs = _chair(rng, n) * 0.4 + [*(rng.uniform(-0.6, 0.6, 2) * size[:2]), -size[2] + 0.25]
    bin_ = _cylinder(rng, n) * rng.uniform(0.1, 0.3, 3) + [*(rng.uniform(-0.7, 0.7, 2) * size[:2]), -size[2] + 0.2]
    which = rng.uniform(size=(n, 1))
    return np.where(which < 0.65, walls, np.where(which < 0.88, chairs, bin_))


OTHERS = (_knot, _blob, _terrain, _vase, _chair, _room)


def others(count: int, points: int, seed: int) -> np.ndarray:
    """As ``shapes``, of six kinds that are never trained on: knots, blobs, terrains, vases, chairs, rooms."""
    rng = np.random.default_rng(seed)
    return np.stack([_normalised(rng.permutation(OTHERS[i % len(OTHERS)](rng, points))) for i in range(count)])


def _normalised(cloud: np.ndarray) -> np.ndarray:
    cloud = cloud - cloud.mean(0)
    return (cloud * (0.5 / np.abs(cloud).max())).astype(np.float32)
