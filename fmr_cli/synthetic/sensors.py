"""What sensors give of a scene: evenly sampled surfaces, terrestrial scanners, spinning LiDARs, depth cameras.

Each scan keeps where it was taken from, so that what a sensor looked through is known to be free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.voxels import voxel_downsample
from fmr_cli.synthetic.scenes import BALL, CUBE, FAR, Scene, camera_rays, lidar_rays, scan

CELLS = 60  # cells along a scan's longest side: about as fine as a working voxel, and so what a detail has to exceed
DIFFERENT = 1 / 70  # of a scan's size: a point that far from the other surface contradicts it
MOST_POINTS = 40_000  # of a scan: enough for any density to show, few enough to be made in a moment
UNIT_AREA = {CUBE: 24.0, BALL: 4 * np.pi, 2: 6 * np.pi}


@dataclass
class Scan:
    """What a made-up sensor has seen, in the scene's frame.

    points: (N, 3) of surfaces; origin: (3,) of the sensor, None for several or none; stray: (K, 3) points that are no
    surface of the scene (no-returns, sky, people, the sensor's own vehicle); view: (2, 3) corners of the box that the
    scan was cut to, None where all there was to see was kept.
    """

    points: np.ndarray
    origin: np.ndarray | None = None
    stray: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    view: np.ndarray | None = None

    def within(self, low: ArrayLike, high: ArrayLike) -> Scan:
        """The part inside a box: a scan ends where its view was cut, and its border says nothing of the scene."""
        cut = replace(self, view=np.array([low, high], float))
        return replace(cut, points=self.points[cut.sees(self.points)])

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (N, 3) lie in its view."""
        if self.view is None:
            return np.ones(len(points), bool)
        return ((points >= self.view[0]) & (points <= self.view[1])).all(1)

    def thinned(self, count: int, rng: np.random.Generator) -> Scan:
        """At most ``count`` of the points."""
        if len(self.points) <= count:
            return self
        return replace(self, points=self.points[np.sort(rng.permutation(len(self.points))[:count])])

    @property
    def size(self) -> float:
        """The longest side of the bounding box."""
        return float(np.ptp(self.points, axis=0).max())


def overlap(source: np.ndarray, target: np.ndarray, radius: float | None = None) -> tuple[float, float]:
    """The share of each scan's surface, both in one frame, that the other one has within ``radius``.

    Counted on a grid of 2/3 ``radius``, so that a denser part of a scan counts no more than a sparse one; radius: a
    cell of the smaller scan unless given.
    """
    size = min(np.ptp(source, axis=0).max(), np.ptp(target, axis=0).max())
    radius = radius or size / CELLS
    a, b = (voxel_downsample(points, radius / 1.5) for points in (source, target))
    return tuple(  # type: ignore[return-value]
        float(np.isfinite(cKDTree(y).query(x, distance_upper_bound=radius)[0]).mean()) for x, y in ((a, b), (b, a))
    )


def _unit_surface(kind: int, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a unit solid, and their outward normals."""
    if kind == CUBE:
        points, normals = rng.uniform(-1, 1, (count, 3)), np.zeros((count, 3))
        rows, axis, side = np.arange(count), rng.integers(3, size=count), rng.choice([-1.0, 1.0], count)
        points[rows, axis] = normals[rows, axis] = side
        return points, normals
    if kind == BALL:
        points = rng.normal(size=(count, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        return points, points
    angle, height, cap = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count), rng.random(count) < 1 / 3
    radius = np.where(cap, np.sqrt(rng.random(count)), 1.0)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1)
    points = out * radius[:, None] + np.outer(np.where(cap, np.sign(height), height), [0, 0, 1])
    return points, np.where(cap[:, None], np.outer(np.sign(height), [0, 0, 1]), out)


def _stretch(kind: int, A: np.ndarray) -> float:
    """The largest factor by which the map A grows an area of the unit solid's surface."""
    L = A[:3, :3]
    if kind == CUBE:
        return float(np.abs(np.linalg.det(L)) * np.linalg.norm(np.linalg.inv(L), axis=1).max())
    return float(np.abs(np.linalg.det(L)) / np.linalg.svd(L, compute_uv=False)[-1])


def inside(A: np.ndarray, kind: int, points: np.ndarray, grow: float = 0.0) -> np.ndarray:
    """Which points (N, 3) lie within a unit solid under the map A (4, 4), grown by ``grow`` of its half extents."""
    near = ((points - A[:3, 3]) ** 2).sum(1) < (1 + grow) ** 2 * (A[:3, :3] ** 2).sum()
    where = np.flatnonzero(near)
    inverse = np.linalg.inv(A)
    u = points[where] @ inverse[:3, :3].T + inverse[:3, 3]
    if kind == CUBE:
        reach = np.abs(u).max(1)
    elif kind == BALL:
        reach = np.linalg.norm(u, axis=1)
    else:
        reach = np.maximum(np.linalg.norm(u[:, :2], axis=1), np.abs(u[:, 2]))
    near[where] = reach < 1 + grow
    return near


def clearance(scene: Scene, points: np.ndarray, shells: Sequence[int] = ()) -> np.ndarray:
    """How far points (N, 3) are from all that is solid, negative within it: (N,).

    Exact outside of cuboids, round cylinders and balls, less than that of oblong ones. shells: solids that are hollow.
    """
    least = np.full(len(points), np.inf)
    for i, (kind, A) in enumerate(zip(scene.kinds, scene.maps, strict=True)):
        half = np.linalg.norm(A[:3, :3], axis=0)
        u = (points - A[:3, 3]) @ (A[:3, :3] / half)
        if kind == CUBE:
            off = np.abs(u) - half
        elif kind == BALL:
            off = (np.linalg.norm(u / half, axis=1, keepdims=True) - 1) * half.min()
        else:
            round_about = (np.linalg.norm(u[:, :2] / half[:2], axis=1) - 1) * half[:2].min()
            off = np.column_stack([round_about, np.abs(u[:, 2]) - half[2]])
        away = np.linalg.norm(np.maximum(off, 0), axis=1) + np.minimum(off.max(1), 0)
        least = np.minimum(least, -away if i in shells else away)
    return least


def surface_scan(
    scene: Scene, rng: np.random.Generator, density: float, facing: np.ndarray | None = None, shells: Sequence[int] = ()
) -> Scan:
    """Points spread evenly over the scene's surfaces, ``density`` to a square unit, at most about MOST_POINTS.

    What lies inside another solid is left out; shells: solids that are hollow, seen from within. With ``facing`` (3,),
    only what faces that place: an even scan from there that nothing hides.
    """
    solids = list(zip(scene.kinds, scene.maps, strict=True))
    maps = np.array(scene.maps)
    centres, halves = maps[:, :3, 3], np.abs(maps[:, :3, :3]).sum(2)  # of boxes about the solids
    area = [UNIT_AREA[kind] * _stretch(kind, A) for kind, A in solids]
    density = min(density, 1.5 * MOST_POINTS / sum(area))
    parts = []
    for i, (kind, A) in enumerate(solids):
        points, normals = _unit_surface(kind, rng.poisson(density * area[i]), rng)
        normals = normals @ np.linalg.inv(A[:3, :3])
        grown = np.linalg.norm(normals, axis=1) * np.abs(np.linalg.det(A[:3, :3]))
        points = points @ A[:3, :3].T + A[:3, 3]
        keep = rng.random(len(points)) * _stretch(kind, A) < grown
        if facing is not None:
            keep &= np.einsum("ni,ni->n", normals, facing - points) * (-1 if i in shells else 1) > 0
        points = points[keep]
        for j in np.flatnonzero((np.abs(centres - centres[i]) < halves + halves[i]).all(1)):
            if j != i and j not in shells and len(points):
                points = points[~inside(maps[j], scene.kinds[j], points, -1e-6)]
        parts.append(points)
    return Scan(np.concatenate(parts), facing).thinned(MOST_POINTS, rng)


def _cast(scene: Scene, origin: np.ndarray, rays: np.ndarray, rng: np.random.Generator, reach: float) -> np.ndarray:
    return scan(scene, origin, rays, rng, 0.0, min(reach, 0.5 * FAR))


def terrestrial_scan(
    scene: Scene, rng: np.random.Generator, origin: ArrayLike, reach: float, columns: int = 240
) -> Scan:
    """All round from a tripod, even in azimuth and elevation, 60 deg below the horizon to the zenith."""
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, columns, False) + rng.uniform(0, 1),
        np.radians(np.linspace(-60, 85, int(columns * 145 / 360))),
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    at = np.asarray(origin, float)
    return Scan(_cast(scene, at, rays, rng, reach), at)


def lidar_scan(
    scene: Scene, rng: np.random.Generator, origin: ArrayLike, reach: float, beams: int = 32, columns: int = 600
) -> Scan:
    """One revolution of a spinning scanner, tilted by about a degree."""
    turn = Rotation.from_euler("zyx", [rng.uniform(0, 2 * np.pi), *rng.normal(0, 0.02, 2)])
    at = np.asarray(origin, float)
    return Scan(_cast(scene, at, lidar_rays(turn, beams, columns), rng, reach), at)


def camera_scan(
    scene: Scene,
    rng: np.random.Generator,
    origin: ArrayLike,
    towards: ArrayLike,
    reach: float,
    views: int = 4,
    width: int = 96,
    wander: float = 0.35,
    fov: float = 62.0,
) -> Scan:
    """Views of a depth camera about origin (3,), looking along ``towards`` (3,) give or take ``wander`` rad, fused."""
    at, d = np.asarray(origin, float), np.asarray(towards, float)
    heading, dip = np.arctan2(d[1], d[0]), -np.arctan2(d[2], np.hypot(d[0], d[1]))
    parts = []
    for i in range(views):
        turn = wander * (2 * (i + rng.random()) / views - 1) if views > 1 else 0.0
        look = Rotation.from_euler("zy", [heading + turn, dip + rng.normal(0, 0.2 * wander)])
        place = at + (rng.normal(0, 0.02 * reach, 3) if views > 1 else 0)
        parts.append(_cast(scene, place, camera_rays(look, width, width * 3 // 4, fov), rng, reach))
    return Scan(np.concatenate(parts), at if views == 1 else None)


def object_scan(scene: Scene, rng: np.random.Generator, directions: np.ndarray, width: int = 72) -> Scan:
    """An object about the scene's origin seen by a depth camera from each of the directions (k, 3), fused."""
    centres = np.array([A[:3, 3] for A in scene.maps])
    radius = max(np.linalg.norm(c) + np.sqrt((A[:3, :3] ** 2).sum()) for c, A in zip(centres, scene.maps, strict=True))
    parts = []
    for d in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        look = Rotation.align_vectors(-d[None], np.array([[1.0, 0, 0]]))[0] * Rotation.from_euler(
            "x", rng.uniform(0, 2 * np.pi)
        )
        parts.append(_cast(scene, 3 * radius * d, camera_rays(look, width, width, 40), rng, 10 * radius))
    return Scan(np.concatenate(parts), 3 * radius * d if len(directions) == 1 else None)


def all_round(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) unit directions spread evenly over the sphere, turned at random."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    return Rotation.random(random_state=rng).apply(np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1))
