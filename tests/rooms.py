"""Scans of one made-up room with exact truth, which several folders of tests share."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.sensors import terrestrial_scan

NOISE = 0.002  # m


def room_views(
    seed: int, count: int, points: int = 9_000, columns: int = 160
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Scans (n, 3) of one room from a walk through it, each in a frame of its own, and T_world_scan of each."""
    rng = np.random.default_rng(seed)
    room = scenes.room(rng)
    clouds, truth = [], []
    for k in range(count):
        eye = np.array([0.7 * np.cos(k), 0.7 * np.sin(k), 1.4 + 0.05 * k])
        view = terrestrial_scan(room, rng, eye, 20.0, columns=columns).points
        view = view + rng.normal(size=view.shape) * NOISE
        T_world_scan = np.eye(4)
        T_world_scan[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        T_world_scan[:3, 3] = rng.uniform(-5, 5, 3)
        inverse = np.linalg.inv(T_world_scan)
        clouds.append(rng.permutation(view)[:points] @ inverse[:3, :3].T + inverse[:3, 3])
        truth.append(T_world_scan)
    return clouds, truth
