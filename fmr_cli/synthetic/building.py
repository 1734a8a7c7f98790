"""A made-up office building whose rooms resemble each other, and the places to scan it from; metres, z up."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.synthetic.scenes import CUBE, CYLINDER, Scene, scan

NOISE = 0.002  # m, of a terrestrial scanner's ranges
HEIGHT, WALL, DOOR, DOOR_HEIGHT = 2.8, 0.15, 0.9, 2.1  # of the building, m
ROOM, DEPTH, CORRIDOR = 5.4, 4.8, 2.2  # along the corridor, away from it, across it
CORNER = np.array([-(DEPTH + CORRIDOR), DEPTH + CORRIDOR])  # where the second wing begins, clear of the first's rooms


def wall(scene: Scene, start: np.ndarray, end: np.ndarray, doors: tuple[float, ...] = ()) -> None:
    """A wall from start to end (x, y), along x or y, with open doors whose middles lie so far along it."""
    length = float(np.linalg.norm(end - start))
    u = (end - start) / length
    half_across = WALL / 2 * np.abs(u[::-1])

    def piece(a: float, b: float, low: float, high: float) -> None:
        middle = start + u * (a + b) / 2
        half = np.abs(u) * (b - a) / 2 + half_across
        scene.add(CUBE, [*middle, (low + high) / 2], [*half, (high - low) / 2])

    at = 0.0
    for door in doors:
        piece(at, door - DOOR / 2, 0, HEIGHT)
        piece(door - DOOR / 2, door + DOOR / 2, DOOR_HEIGHT, HEIGHT)
        at = door + DOOR / 2
    piece(at, length, 0, HEIGHT)


def furnish(scene: Scene, rng: np.random.Generator, corner: np.ndarray, size: np.ndarray, inward: int) -> None:
    """An office like its neighbours: desk, cupboards and shelves in their usual places; things on them."""
    x0, y0 = corner
    back = y0 + (size[1] if inward > 0 else 0)
    away = -inward
    desk = np.array([x0 + 1.4 + rng.normal(0, 0.15), back + away * (0.55 + abs(rng.normal(0, 0.1)))])
    turn = Rotation.from_euler("z", rng.normal(0, 0.05))
    scene.add(CUBE, [*desk, 0.73], [0.8, 0.4, 0.02], turn)
    for sx in (-1, 1):
        scene.add(CUBE, [*(desk + turn.apply([0.75 * sx, 0, 0])[:2]), 0.36], [0.03, 0.36, 0.36], turn)
    for _ in range(rng.integers(1, 5)):
        at = desk + turn.apply([*rng.uniform([-0.7, -0.3], [0.7, 0.3]), 0])[:2]
        half = rng.uniform(0.05, 0.2, 3)
        scene.add(CUBE, [*at, 0.75 + half[2]], half, Rotation.from_euler("z", rng.uniform(0, 6)))
    width = rng.choice([0.4, 0.6])
    scene.add(CUBE, [x0 + size[0] - width - 0.1, back + away * 0.25, 0.9], [width, 0.2, 0.9])
    for _ in range(rng.integers(2, 6)):  # chairs, bins, boxes, wherever they were left
        at = [x0 + rng.uniform(0.6, size[0] - 0.6), y0 + rng.uniform(1.0, size[1] - 1.0)]
        half = rng.uniform(0.12, 0.35, 3)
        kind = CYLINDER if rng.random() < 0.4 else CUBE
        scene.add(kind, [*at, half[2]], half, Rotation.from_euler("z", rng.uniform(0, 6)))


def building(rng: np.random.Generator) -> tuple[Scene, list[np.ndarray]]:
    """Two corridors at a right angle with 16 offices along them, and 40 places to scan from.

    Each office is scanned from its middle and from the threshold of its open door, the corridors from between two doors
    and from where they meet.
    """
    scene, eyes = Scene(), []
    scene.add(CUBE, [0, 0, -0.1], [60, 60, 0.1])
    scene.add(CUBE, [0, 0, HEIGHT + 0.1], [60, 60, 0.1])
    for wing, count in ((0, 6), (1, 2)):
        length = count * ROOM
        turned = (lambda p: np.array(p, float)) if wing == 0 else (lambda p: np.array([-p[1], p[0]], float) + CORNER)
        doors = tuple(ROOM * (k + 0.5) for k in range(count))
        for side in (-1, 1):
            y = side * (CORRIDOR + WALL) / 2
            wall(scene, turned([0, y]), turned([length, y]), doors)
            wall(scene, turned([0, y + side * (DEPTH + WALL)]), turned([length, y + side * (DEPTH + WALL)]))
            for k in range(count + 1):
                ends = sorted([y + side * WALL / 2, y + side * (DEPTH + WALL / 2)])
                wall(scene, turned([k * ROOM, ends[0]]), turned([k * ROOM, ends[1]]))
            for k in range(count):
                low = turned([k * ROOM + WALL / 2, min(y, y + side * DEPTH) + WALL / 2])
                high = turned([(k + 1) * ROOM - WALL / 2, max(y, y + side * DEPTH) + WALL / 2])
                corner, size = np.minimum(low, high), np.abs(high - low)
                furnish(scene, rng, corner, size, side)
                middle = turned([(k + 0.5) * ROOM, y + side * DEPTH * 0.55]) + rng.normal(0, 0.3, 2)
                threshold = turned([(k + 0.5) * ROOM, y]) + rng.normal(0, 0.05, 2)
                eyes += [np.array([*p, 1.6 + rng.normal(0, 0.05)]) for p in (middle, threshold)]
        stands = [turned([d, 0]) for d in doors]
        if wing == 0:
            stands[2] = np.array([CORNER[0], 0.0])  # where the corridors meet, instead of between two doors
        eyes += [np.array([*(stand + rng.normal(0, 0.1, 2)), 1.6]) for stand in stands]
        for k in range(6 * count):  # what hangs and stands in a corridor, clear of the doors: cabinets, benches, boards
            side, along = rng.choice([-1, 1]), rng.uniform(0.05, 0.37) + 0.5 * (k % 2)
            half = rng.uniform([0.15, 0.08, 0.15], [0.5, 0.25, 0.8])
            at = turned([(k // 6 + 0.02 + along) * ROOM, side * (CORRIDOR / 2 - half[1])])
            low = half[2] if rng.random() < 0.6 else rng.uniform(half[2], HEIGHT - half[2])
            scene.add(CUBE, [*at, low], half if wing == 0 else half[[1, 0, 2]])
        wall(scene, turned([length, -CORRIDOR / 2]), turned([length, CORRIDOR / 2]))
    wall(scene, np.array([CORNER[0] - CORRIDOR / 2, -CORRIDOR / 2]), np.array([0, -CORRIDOR / 2]))
    wall(scene, np.array([CORNER[0] - CORRIDOR / 2, -CORRIDOR / 2]), np.array([CORNER[0] - CORRIDOR / 2, CORNER[1]]))
    wall(scene, np.array([CORNER[0] + CORRIDOR / 2, CORRIDOR / 2]), np.array([0, CORRIDOR / 2]))
    wall(scene, np.array([CORNER[0] + CORRIDOR / 2, CORRIDOR / 2]), np.array([CORNER[0] + CORRIDOR / 2, CORNER[1]]))
    return scene, eyes


def terrestrial(scene: Scene, eye: np.ndarray, rng: np.random.Generator, columns: int = 480) -> np.ndarray:
    """World points of one scan, all round, 60 deg below the horizon to the zenith."""
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, columns, False), np.radians(np.linspace(-60, 89, int(columns * 149 / 360)))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    points = scan(scene, eye, rays, rng, 0.0, 30.0)
    away = points - eye
    return points + away / np.linalg.norm(away, axis=1, keepdims=True) * rng.normal(0, NOISE, (len(away), 1))
