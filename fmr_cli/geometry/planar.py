"""Scans that are flat by nature: curves in one plane, as a 2-D scanner or a floor plan gives them.

Raised into walls, they are surfaces like any other; their motion is then kept to the plane.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.sampling import sample
from fmr_cli.geometry.voxels import occupied_voxels

THIN = 1e-3  # of the largest deviation: a scan that is thinner lies in a plane, rooms and streets do not
CURVES = 2.8  # times as many voxels of half the edge: 2 on a curve, 4 where the plane is filled, as by a wall
FULL = 16.0  # points in a voxel, on the mean, at which that is counted: with fewer, chance empties voxels
CELLS = 100.0  # edges in the largest deviation, at most
HEIGHT = 0.3  # of the largest deviation, that the curves are raised to
LAYERS, RAISED = 12, 60_000  # copies of each point, and how many points they may come to


def plane_of(points: np.ndarray) -> np.ndarray | None:
    """The unit normal (3,) of the plane in which points (N, 3), centred, lie along curves, or None."""
    some = points[:: max(len(points) // 20_000, 1)]
    values, vectors = np.linalg.eigh(some.T @ some / len(some))
    deviation = np.sqrt(np.maximum(values, 0))
    if len(points) < 30 or deviation[0] > THIN * deviation[2] or deviation[1] <= THIN * deviation[2]:
        return None
    edge = deviation[2]
    while occupied_voxels(some, edge / 2) < len(some) / FULL and edge > deviation[2] / CELLS:
        edge /= 2
    filled = occupied_voxels(some, edge / 2) > CURVES * occupied_voxels(some, edge)
    return None if filled else vectors[:, 0]


def raised(points: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3), centred, of a plane as walls on both sides of it: (M, 3)."""
    some = sample(points, RAISED // LAYERS, rng)
    height = HEIGHT * np.sqrt(np.linalg.eigvalsh(some.T @ some / len(some))[2])
    layers = np.linspace(-height / 2, height / 2, LAYERS)
    return (some[:, None] + layers[:, None] * normal).reshape(-1, 3)


def within_plane(T_target_source: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The pose next to T (4, 4) that takes the source's plane onto the target's.

    Each goes through its cloud's centre, which is its frame's origin, and has a unit normal (3,).
    """
    T = T_target_source.copy()
    moved = T[:3, :3] @ source
    target = target * np.sign(moved @ target)
    axis, cosine = np.cross(moved, target), float(moved @ target)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T[:3, :3] = (np.eye(3) + K + K @ K / (1 + cosine)) @ T[:3, :3]
    T[:3, 3] -= (T[:3, 3] @ target) * target
    return T
