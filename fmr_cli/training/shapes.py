"""Procedural shapes: training data for the bundled encoder, which has never seen a real scan.

Each shape is a union of 2 to 7 boxes, spheres, cylinders, cones, tori and planes with random proportions, turned at random
or (every third shape) only about the vertical, as things that people build stand.
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
    spins = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi, (parts, 1)) * [0, 0, 1]) if upright else Rotation.random(parts, rng)
    centres = rng.uniform(-0.8, 0.8, (parts, 3))
    bodies = []
    for scale, count, spin, centre in zip(scales, counts, spins, centres, strict=True):
        primitive = PRIMITIVES[rng.integers(len(PRIMITIVES))]
        bodies.append(spin.apply(primitive(rng, count) * scale) + centre if count else np.empty((0, 3)))
    return np.concatenate(bodies)


def shapes(count: int, points: int, seed: int) -> np.ndarray:
    """(count, points, 3) float32 random shapes, each centred on its mean and scaled to a largest half extent of 0.5."""
    rng = np.random.default_rng(seed)
    pool = np.empty((count, points, 3), np.float32)
    for i in range(count):
        cloud = rng.permutation(shape(rng, points))
        cloud -= cloud.mean(0)
        pool[i] = cloud * (0.5 / np.abs(cloud).max())
    return pool
