"""Pairs of made-up scans that the verdict is calibrated on: right poses of every kind, and wrong ones that look right.

Views of one scene from two places, rooms that are nearly bare, one object seen from two sides, and scans dealt out to
two and cut, some of them flattened; three tenths are scans of two different scenes, where no pose is right. Many are
thinned, noisy, or hold things that the other scan does not. No real scan is involved. Lengths are metres in rooms and
streets; objects are about 1 in size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.voxels import voxel_keys
from fmr_cli.synthetic import scenes, shapes
from fmr_cli.synthetic.pairs import degrade, scan_pair

Maker = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]

LEAST_POINTS = 1000  # of a scan that has not missed its scene: some hundred voxels that hold a point
OBJECT_POINTS = 20_000  # of an object all round; a depth camera's view of one has about as many
# Shares that cover the kinds of material; chosen, not measured.
TOGETHER = 0.7  # of the pairs are of one scene
DEGRADED, CLUTTERED = 0.4, 0.3  # of the pairs
OF_ONE_SIZE = 0.7  # of the pairs of two scenes: else their sizes alone would tell them apart
BLOBS = 40  # of clutter, fewer than that
BLOB_SHARE = 0.012  # of a scan's points in a blob, at most: all blobs together about a third at most
FRONT_CELLS = 50  # cells across an object, in each of which what lies more than 3 cells behind the front is hidden


def calibration_pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, bool]:
    """Source (N, 3), target (M, 3), and whether they belong together; in the scene's frame where they do."""
    source, target = full_pair(any_maker(rng), rng)
    together = rng.random() < TOGETHER
    if not together:
        source, _ = full_pair(any_maker(rng), rng)
        if rng.random() < OF_ONE_SIZE:
            source = (source - source.mean(0)) * (np.ptp(target, axis=0).max() / np.ptp(source, axis=0).max())
    if rng.random() < DEGRADED:
        source, target = degrade(source, rng), degrade(target, rng)
    if rng.random() < CLUTTERED:  # what moved, grew or was not there: up to a third of a scan is the scan's own
        source, target = clutter(source, rng), clutter(target, rng)
    return source, target, together


def any_maker(rng: np.random.Generator) -> Maker:
    """One of the four kinds of pairs."""
    makers: tuple[Maker, ...] = (scan_pair, bare_rooms, faces, halves)
    return makers[rng.choice(4, p=(0.35, 0.15, 0.2, 0.3))]


def full_pair(maker: Maker, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two scans, neither of which has missed the scene."""
    while True:
        source, target = maker(rng)
        if min(len(source), len(target)) >= LEAST_POINTS:
            return source, target


def bare_rooms(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Scans of a room that holds up to five things: turned by 90 or 180 deg it looks much the same."""
    scene = scenes.room(rng)
    held = [0, *rng.choice(np.arange(1, len(scene.kinds)), rng.integers(0, 6), replace=False)]
    scene = scenes.Scene([scene.kinds[i] for i in held], [scene.maps[i] for i in held])
    eye, heading = np.array([*rng.normal(0, 0.7, 2), rng.uniform(1, 1.8)]), rng.uniform(0, 2 * np.pi)
    first = scenes.room_scan(scene, rng, eye, heading)
    return first, scenes.room_scan(scene, rng, eye + rng.normal(0, 0.5, 3) * [1, 1, 0.3], heading + rng.normal(0, 0.6))


def thing(rng: np.random.Generator) -> np.ndarray:
    """An object all round, of any shape, some of them flattened: (OBJECT_POINTS, 3)."""
    makers = [shapes.shape, shapes.shape, *shapes.OTHERS]
    points = makers[rng.integers(len(makers))](rng, OBJECT_POINTS)
    flat = rng.uniform(0.01, 0.3) if rng.random() < 0.25 else 1.0  # sheets, reliefs
    return points * np.where(np.arange(3) == rng.integers(3), flat, 1.0)


def faces(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """What two cameras, 15 to 80 deg apart, see of one object."""
    points, towards = rng.permutation(thing(rng)), rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(rng.uniform(15, 80)) * unit(np.cross(towards, rng.normal(size=3))))
    return seen(points[::2], towards), seen(points[1::2], turn.apply(towards))


def seen(points: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """The points that hide each other least from a camera far away in the direction ``towards`` (3,)."""
    local = points @ Rotation.align_vectors([[0, 0, 1.0]], unit(towards)[None])[0].as_matrix().T
    cell = np.ptp(local, axis=0).max() / FRONT_CELLS
    column = np.unique(voxel_keys((local - local.min(0)) * [1, 1, 0], cell), return_inverse=True)[1]
    top = np.full(column.max() + 1, -np.inf)
    np.maximum.at(top, column, local[:, 2])
    return points[local[:, 2] > top[column] - 3 * cell]


def halves(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The points of one scan dealt out to two, each of them cut by the same plane from its own side."""
    points = rng.permutation(thing(rng) if rng.random() < 0.7 else full_pair(scan_pair, rng)[0])
    depth, common = points @ unit(rng.normal(size=3)), rng.choice([1.0, rng.uniform(0.4, 1.0)])
    low, high = np.quantile(depth, [(1 - common) / (2 - common), 1 / (2 - common)])
    first = np.arange(len(points)) % 2 == 0
    return points[first & (depth >= low)], points[~first & (depth <= high)]


def unit(v: np.ndarray) -> np.ndarray:
    """The vector at length 1."""
    return v / np.linalg.norm(v)


def clutter(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The scan with points of its own in blobs about some of its points."""
    size = np.ptp(points, axis=0).max()
    blobs = [points]
    for _ in range(rng.integers(1, BLOBS)):
        count = int(rng.uniform(0, BLOB_SHARE) * len(points))
        spread = rng.uniform(0.003, 0.04, 3) * size
        blobs.append(points[rng.integers(len(points))] + rng.normal(size=(count, 3)) * spread)
    return np.concatenate(blobs)
