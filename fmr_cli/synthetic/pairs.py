"""Two made-up scans of one scene from two places, as sensors would give them."""

from __future__ import annotations

import numpy as np

from fmr_cli.synthetic import scenes


def scan_pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two scans of one procedural scene from different places, in the scene's frame, as a scanner would give them."""
    kind = rng.choice(["room", "street", "thing"], p=[0.5, 0.3, 0.2])
    if kind == "room":
        scene, eye = scenes.room(rng), np.array([*rng.normal(0, 0.7, 2), rng.uniform(1, 1.8)])
        heading = rng.uniform(0, 2 * np.pi)
        first = scenes.room_scan(scene, rng, eye, heading)
        eye = eye + rng.normal(0, 0.5, 3) * [1, 1, 0.3]
        second = scenes.room_scan(scene, rng, eye, heading + rng.uniform(-0.9, 0.9))
    elif kind == "street":
        scene, place = scenes.street(rng), np.array([rng.uniform(-40, 40), rng.uniform(-2, 2), 1.8])
        first = scenes.street_scan(scene, rng, place)
        second = scenes.street_scan(scene, rng, place + np.array([rng.uniform(-20, 20), rng.uniform(-1, 1), 0]))
    else:
        scene, towards = scenes.thing(rng), rng.normal(size=3)
        views = int(rng.integers(1, 8))
        first = scenes.thing_scan(scene, rng, towards, views)
        second = scenes.thing_scan(scene, rng, towards + rng.normal(0, 0.4, 3) * np.linalg.norm(towards), views)
    return first, second


def degrade(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Thin a scan out, and shake it, as sensors differ."""
    if rng.random() < 0.4:
        points = points[rng.random(len(points)) < rng.uniform(0.1, 0.7)]
    if rng.random() < 0.4:
        points = points + rng.normal(0, rng.uniform(0, 0.01) * np.ptp(points, axis=0).max() / 2, points.shape)
    return points
