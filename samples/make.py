"""Makes the two sample scans: a small furnished room, seen by a scanner from two places, each scan in its own frame.

    python -m samples.make [FOLDER]

The room is made of boxes, cylinders and balls. From each place, rays spread evenly over all directions are cast and
the nearest hit is kept, so that each scan sees what the other does not; the range carries 3 mm of noise. Metres.
``truth.txt`` holds T_target_source for scan_a (source) onto scan_b (target).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from fmr_cli import PointCloud, write_cloud, write_transform
from fmr_cli.cloud import transform_points

SEED = 7
RAYS = 8_000
NOISE = 0.003

# The room: x 0..5, y 0..4, z 0..2.6. Boxes are (low corner, high corner), the first one seen from inside.
ROOM = ((0, 0, 0), (5, 4, 2.6))
BOXES = [
    ((1.6, 1.2, 0.70), (3.2, 2.0, 0.75)),  # table top
    *(((x, y, 0), (x + 0.06, y + 0.06, 0.70)) for x in (1.65, 3.09) for y in (1.25, 1.89)),  # its legs
    ((0.0, 0.3, 0.0), (0.4, 1.5, 1.9)),  # bookcase on the left wall
    ((3.6, 3.3, 0.0), (5.0, 4.0, 0.45)),  # bench in the corner
    ((3.6, 3.85, 0.45), (5.0, 4.0, 0.95)),  # its back
    ((0.9, 3.2, 0.0), (1.6, 3.8, 1.1)),  # chest
    ((4.5, 0.0, 0.0), (5.0, 0.7, 2.1)),  # wardrobe
]
CYLINDERS = [
    ((2.6, 1.6, 0.75), 0.09, 0.30),
    ((4.2, 1.9, 0.0), 0.22, 0.50),
    ((0.35, 2.4, 0.0), 0.05, 1.60),
]  # foot, r, h
BALLS = [((0.35, 2.4, 1.72), 0.18), ((1.95, 1.5, 0.87), 0.12), ((1.25, 3.5, 1.24), 0.14)]  # centre, r

SCANNERS = {"scan_a": (3.9, 2.6, 1.5), "scan_b": (1.1, 2.2, 1.6)}


def directions(n: int, turn: np.ndarray) -> np.ndarray:
    """n unit vectors (n, 3) spread evenly over the sphere (a Fibonacci spiral), turned by a rotation (3, 3)."""
    i = np.arange(n) + 0.5
    z, phi = 1 - 2 * i / n, i * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], 1) @ turn.T


def hit_box(o: np.ndarray, d: np.ndarray, low: tuple, high: tuple, inside: bool = False) -> np.ndarray:
    """Ranges (n,) at which rays from o (3,) along d (n, 3) meet a box; infinite where they miss."""
    t1, t2 = (np.array(low) - o) / d, (np.array(high) - o) / d
    enter, leave = np.minimum(t1, t2).max(1), np.maximum(t1, t2).min(1)
    return leave if inside else np.where((enter < leave) & (enter > 0), enter, np.inf)


def hit_ball(o: np.ndarray, d: np.ndarray, centre: tuple, radius: float) -> np.ndarray:
    b = d @ (o - np.array(centre))
    root = b * b - np.sum((o - np.array(centre)) ** 2) + radius * radius
    return np.where((root > 0) & (b < 0), -b - np.sqrt(np.maximum(root, 0)), np.inf)


def hit_cylinder(o: np.ndarray, d: np.ndarray, foot: tuple, radius: float, height: float) -> np.ndarray:
    """An upright cylinder's side (scanners stand outside of it and see no end but the top of low ones, left open)."""
    p, q = o[:2] - np.array(foot[:2]), d[:, :2]
    a, b, c = np.sum(q * q, 1), q @ p, p @ p - radius * radius
    root = b * b - a * c
    t = (-b - np.sqrt(np.maximum(root, 0))) / a
    z = o[2] + t * d[:, 2] - foot[2]
    return np.where((root > 0) & (t > 0) & (z > 0) & (z < height), t, np.inf)


def scan(position: tuple, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (RAYS, 3) in the room's frame, and the number (RAYS,) of the thing that each one lies on (0: the room)."""
    o, d = np.array(position), directions(RAYS, random_rotation(rng))
    ranges = np.stack(
        [hit_box(o, d, *ROOM, inside=True)]
        + [hit_box(o, d, *box) for box in BOXES]
        + [hit_cylinder(o, d, *cylinder) for cylinder in CYLINDERS]
        + [hit_ball(o, d, *ball) for ball in BALLS]
    )
    return o + d * (ranges.min(0) + rng.normal(0, NOISE, RAYS))[:, None], ranges.argmin(0)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.linalg.det(Q)


def main(folder: Path) -> None:
    rng = np.random.default_rng(SEED)
    palette = rng.integers(60, 256, (1 + len(BOXES) + len(CYLINDERS) + len(BALLS), 3), dtype=np.uint8)
    room_to_scan = {}
    for name, position in SCANNERS.items():
        points, thing = scan(position, rng)
        T = np.eye(4)  # the scanner's own frame: the origin at the scanner, the axes turned at random
        T[:3, :3] = random_rotation(rng)
        T[:3, 3] = -T[:3, :3] @ position
        colours = dict(zip(("red", "green", "blue"), palette[thing].T, strict=True))
        write_cloud(folder / f"{name}.ply", PointCloud(transform_points(T, points).astype(np.float32), colours))
        room_to_scan[name] = T
    write_transform(folder / "truth.txt", room_to_scan["scan_b"] @ np.linalg.inv(room_to_scan["scan_a"]))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
