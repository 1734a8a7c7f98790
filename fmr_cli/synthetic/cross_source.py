"""Cross-source pairs: a photogrammetric cloud of a room or an object, and what a depth camera or a laser sees of it.

What sets photogrammetry apart: edges come out smooth, surfaces bend and have bumps, small holes and whole patches
without texture are missing, the density varies, and the scale is the cloud's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.sampling import sample
from fmr_cli.synthetic import scenes, sensors
from fmr_cli.synthetic.draft import log_uniform

SENSORS = ("depth camera", "laser")
NOISE = {"depth camera": 0.002, "laser": 0.0003}  # standard deviation, of the size: 1 cm and 1.5 mm of a 5 m room
POINTS = 16_000  # of a cloud
DEFECT = 0.01  # of the size: the length that smoothing, bumps and noise go by, at strength 1
SMOOTHED, BUMPS, SPECKLE = 2.0, 0.4, 0.15  # of that length: radius; standard deviations
WAVES, LONGEST, SHORTEST = 12, 1.0, 0.1  # of the bumps; wavelengths, of the size
HOLES, HOLE = 15, (0.01, 0.04)  # how many at strength 1; radius, of the size
PATCHES, PATCH = 3, (0.08, 0.16)
SCALE = 0.05, 20.0  # the cloud's own unit in the target's
FEWEST_SOLIDS = 5  # of an object: two or three are often symmetric


@dataclass(frozen=True)
class CrossSourcePair:
    """source (N, 3), photogrammetric, and target (M, 3).

    T_target_source (4, 4): the similarity between them; scale: its factor; size: the target's largest extent.
    """

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    scale: float
    size: float


def cross_source_pair(sensor: str, strength: float, rng: np.random.Generator) -> CrossSourcePair:
    """A fresh pair onto one of SENSORS; strength: of the photogrammetric defects, 1 as usual."""
    camera = sensor == SENSORS[0]
    if rng.random() < 0.5:
        surface, target = room(rng, camera)
    else:
        surface, target = thing(rng, camera)
    size = float(np.ptp(target, axis=0).max())
    target = sample(target, POINTS, rng)
    target = target + rng.normal(0, NOISE[sensor] * size, target.shape)
    cloud = photogrammetric(sample(surface, POINTS, rng), size, strength, rng)
    scale = log_uniform(rng, *SCALE)
    T = np.eye(4)
    T[:3, :3] = scale * Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.normal(0, size, 3)
    return CrossSourcePair(transform_points(np.linalg.inv(T), cloud), target, T, scale, size)


def room(rng: np.random.Generator, camera: bool) -> tuple[np.ndarray, np.ndarray]:
    """All surfaces of a room, and what a depth camera turned all round, or a scanner on a tripod, sees of them."""
    scene, eye = scenes.room(rng), np.array([*rng.normal(0, 0.4, 2), 1.5])
    surface = sensors.surface_scan(scene, rng, 200.0, shells=[0]).points
    if camera:
        seen = sensors.camera_scan(scene, rng, eye, [1, 0, -0.1], 8.0, views=12, wander=np.pi)
    else:
        seen = sensors.terrestrial_scan(scene, rng, eye, 20.0, columns=300)
    return surface, seen.points


def thing(rng: np.random.Generator, camera: bool) -> tuple[np.ndarray, np.ndarray]:
    """All of an object's surface, and what a depth camera led around it, or a scanner from four stands, sees of it."""
    scene = scenes.thing(rng)
    while len(scene.kinds) < FEWEST_SOLIDS:
        scene = scenes.thing(rng)
    surface = sensors.surface_scan(scene, rng, 20_000.0).points
    if camera:
        return surface, sensors.object_scan(scene, rng, sensors.all_round(10, rng), 96).points
    around = rng.uniform(0, 2 * np.pi) + np.pi / 2 * np.arange(4)
    stands = np.column_stack([np.cos(around), np.sin(around), np.full(4, 0.4)])
    return surface, sensors.object_scan(scene, rng, stands, 160).points


def photogrammetric(points: np.ndarray, size: float, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Points of a surface (N, 3) as images would give them, fewer than before; strength 0 leaves them as they are."""
    length = strength * DEFECT * size
    if not length:
        return points
    tree = cKDTree(points)
    near = tree.query(points, 32, distance_upper_bound=SMOOTHED * length)[1]
    there = (near < len(points))[..., None]
    found = (points[np.minimum(near, len(points) - 1)] * there).sum(1) / there.sum(1)
    found = found + BUMPS * length * waves(found / size, rng, 3) + rng.normal(0, SPECKLE * length, found.shape)
    kept = rng.random(len(points)) < 1 / (1 + np.exp(-1 - waves(points / size, rng, 1)[:, 0]))
    for count, radii in ((HOLES, HOLE), (PATCHES, PATCH)):
        for _ in range(round(count * strength)):
            kept[tree.query_ball_point(points[rng.integers(len(points))], size * rng.uniform(*radii))] = False
    return found[kept]


def waves(x: np.ndarray, rng: np.random.Generator, components: int) -> np.ndarray:
    """A smooth random field at x (N, 3), (N, components), of variance 1: plane waves."""
    ways = rng.normal(size=(WAVES, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    lengths = np.exp(rng.uniform(np.log(SHORTEST), np.log(LONGEST), WAVES))
    phases = rng.uniform(0, 2 * np.pi, (components, WAVES))
    along = 2 * np.pi * (x @ ways.T) / lengths  # [N x WAVES]
    return np.stack([np.sqrt(2 / WAVES) * np.sin(along + phase).sum(1) for phase in phases], 1)
