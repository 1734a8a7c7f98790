"""A street with a LiDAR driving through it, ray-cast with exact truth: boxes, poles and ground; metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmr_cli.geometry.se3 import exp

STEP = 0.1  # seconds between scans


@dataclass(frozen=True)
class Street:
    """boxes: (B, 2, 3) lowest and highest corner; poles: (P, 4) x, y, radius, height; the ground is z = 0."""

    boxes: np.ndarray
    poles: np.ndarray


def make_street(size: float, seed: int = 0) -> Street:
    """Blocks of houses on both sides of a square round of streets of edge ``size``, with poles and parked cars."""
    rng = np.random.default_rng(seed)
    boxes, poles = [], []
    for side in range(4):
        turn = np.array([[0, -1], [1, 0]])
        R = np.linalg.matrix_power(turn, side)
        along = -size / 2 - 14
        while along < size / 2 + 14:
            width = rng.uniform(5, 11)
            for offset, inner in ((-size / 2 - 8, False), (-size / 2 + 8, True)):
                if inner and not -size / 2 + 10 < along < size / 2 - 10 - width:
                    continue
                depth, height = rng.uniform(3, 7), rng.uniform(4, 12)
                gap = rng.uniform(0, 1.5)
                y = (offset + gap, offset + gap + depth) if inner else (offset - gap - depth, offset - gap)
                corners = np.array([[along, y[0]], [along + width, y[1]]]) @ R.T
                boxes.append([[*corners.min(0), 0], [*corners.max(0), height]])
            if rng.random() < 0.6 and -size / 2 + 6 < along < size / 2 - 6:
                y = -size / 2 + rng.choice([-4.5, 4.5])
                corners = np.array([[along, y - 0.9], [along + 4.2, y + 0.9]]) @ R.T
                boxes.append([[*corners.min(0), 0], [*corners.max(0), 1.5]])
            x, y = R @ [along + rng.uniform(0, 5), -size / 2 + rng.choice([-6, 6])]
            poles.append([x, y, rng.uniform(0.08, 0.3), rng.uniform(3, 8)])
            along += width + rng.uniform(1, 6)
    return Street(np.array(boxes), np.array(poles))


def drive(size: float, speed: float = 8.0, turn: float = 40.0, rest: int = 5) -> np.ndarray:
    """(n, 4, 4) poses of the sensor, 1.8 m up, at 10 Hz: once round the square back to the start, with a standstill.

    It moves at ``speed`` (m/s) from the first scan on, turns at ``turn`` deg/s, and rests for ``rest`` scans half-way.
    """
    radius = speed / np.radians(turn)
    straight, arc = size - 2 * radius, radius * np.pi / 2
    lap = 4 * (straight + arc)
    distances = np.arange(0, lap, speed * STEP)
    half = len(distances) // 2
    distances = np.concatenate([distances[:half], np.full(rest, distances[half]), distances[half:], [lap]])
    poses = np.tile(np.eye(4), (len(distances), 1, 1))
    for pose, s in zip(poses, distances, strict=True):
        side, rest_of = divmod(s + straight / 2, straight + arc)
        side = int(side)
        if rest_of < straight:
            x, y, heading = rest_of - straight / 2, -size / 2, 0.0
        else:
            heading = (rest_of - straight) / radius
            x, y = straight / 2 + radius * np.sin(heading), -size / 2 + radius * (1 - np.cos(heading))
        c, s_ = np.cos(side * np.pi / 2), np.sin(side * np.pi / 2)
        pose[:2, 3] = [c * x - s_ * y, s_ * x + c * y]
        heading += side * np.pi / 2
        pose[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        pose[2, 3] = 1.8
    return poses


def scan(
    street: Street, pose: np.ndarray, rng: np.random.Generator, beams: int = 64, columns: int = 900,
    reach: float = 80.0, noise: float = 0.02,
) -> np.ndarray:  # fmt: skip
    """(N, 3) points in the sensor's frame, of a spinning scanner.

    pose: (4, 4), where it sees everything at one instant; or (columns, 4, 4), where it moves: each column, from
    azimuth 0 to 360 degrees, is seen from its own pose and given in the frame of that pose.
    """
    tangent = np.tan(np.radians(np.linspace(-24.8, 2.0, beams)))  # height gained over horizontal distance
    azimuth = np.arange(columns) * 2 * np.pi / columns
    rays = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    poses = np.broadcast_to(pose, (columns, 4, 4))
    world = np.einsum("cij,cj->ci", poses[:, :2, :2], rays)
    eye, height = poses[:, :2, 3], poses[0, 2, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.tile(np.where(tangent < 0, -height / tangent, np.inf), (columns, 1))  # horizontal, to the ground
        for low, high in street.boxes:
            t1, t2 = (low[:2] - eye) / world, (high[:2] - eye) / world
            enter, leave = np.minimum(t1, t2).max(1), np.maximum(t1, t2).min(1)
            hit = (enter > 0) & (enter < leave) & (enter < reach)
            keep_nearest(distance, hit, enter[hit], leave[hit], high[2] - height, tangent)
        for x, y, radius, top in street.poles:
            offset = eye - [x, y]
            b = (world * offset).sum(1)
            root = b**2 - ((offset**2).sum(1) - radius**2)
            enter = -b - np.sqrt(root)
            hit = (root > 0) & (enter > 0) & (enter < reach)
            keep_nearest(distance, hit, enter[hit], -b[hit] + np.sqrt(root[hit]), top - height, tangent)
    length = distance * np.sqrt(1 + tangent**2)
    column, beam = np.nonzero(length < reach)
    horizontal = distance[column, beam] * (1 + rng.normal(0, noise, len(beam)) / length[column, beam])
    return np.stack([*(rays[column] * horizontal[:, None]).T, horizontal * tangent[beam]], 1)


def keep_nearest(
    distance: np.ndarray, hit: np.ndarray, enter: np.ndarray, leave: np.ndarray, top: float, tangent: np.ndarray
) -> None:
    """Shorten ``distance`` (columns, beams) where a thing is hit, its side or its roof at ``top`` over the eye."""
    side = np.where(enter[:, None] * tangent <= top, enter[:, None], np.inf)
    roof = top / tangent
    roof = np.where((tangent < 0) & (roof > enter[:, None]) & (roof < leave[:, None]), roof, np.inf)
    distance[hit] = np.minimum(distance[hit], np.minimum(side, roof))


def turn_and_shift(degrees: float, shift: float, axis: tuple[float, float, float] = (0.36, 0.48, 0.8)) -> np.ndarray:
    """The pose (4, 4) of a turn about a unit axis and a shift by so much in a fixed direction."""
    T = exp(np.radians([*(degrees * np.array(axis)), 0, 0, 0]))
    T[:3, 3] = shift * np.array([0.6, -0.64, 0.48])
    return T
