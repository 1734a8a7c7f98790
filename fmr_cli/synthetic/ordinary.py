"""Pairs of scans whose geometry leaves the pose open, of little overlap or few points, and plain easy ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.synthetic import scenes, sensors, shapes
from fmr_cli.synthetic.contradicting import free_place, lump, room, room_scans
from fmr_cli.synthetic.draft import (
    Draft,
    Redraw,
    check_points,
    check_tied,
    check_unique,
    common_cells,
    log_uniform,
    look,
    once,
)
from fmr_cli.synthetic.repeating import BIG, object_scans
from fmr_cli.synthetic.scenes import BALL, CUBE, CYLINDER
from fmr_cli.synthetic.sensors import CELLS, Scan, overlap
from fmr_cli.synthetic.structures import Structure, about, motion

LOW, HALF = (0.1, 0.3), (0.3, 0.6)  # bands of overlap
THINGS = 30  # cells of the common surface of two room scans that are no wall, floor or ceiling, at least

Maker = Callable[[np.random.Generator], Draft]


# Degenerate: some direction of the pose stays open.


def open_pair(s: Structure, rng: np.random.Generator, low: np.ndarray, high: np.ndarray, shift: np.ndarray) -> Draft:
    """Scans of what lies in a box, and in the box moved by ``shift`` (3,)."""
    scans = [
        sensors.surface_scan(s.scene, rng, log_uniform(rng, 150, 3000), shells=s.shells).within(low + d, high + d)
        for d in (np.zeros(3), shift)
    ]
    check_points(*scans, least=400)
    return Draft(scans[0], scans[1], once(), unique=False)


def plane(rng: np.random.Generator) -> Draft:
    s, long = Structure(), rng.uniform(2, 10, 2)
    s.box([-4, -4, -0.5], [14, 14, 0])
    shift = np.array([*(rng.uniform(-0.4, 0.4, 2) * long), 0])
    return open_pair(s, rng, np.array([0, 0, -0.1]), np.array([*long, 0.1]), shift)


def tunnel(rng: np.random.Generator) -> Draft:
    """A smooth tube, round, oval or square, along x."""
    s, long = Structure(shells=[0]), rng.uniform(6, 25)
    half = rng.uniform(0.8, 3, 2)
    kind = CUBE if rng.random() < 0.5 else CYLINDER
    s.add(kind, [0, 0, 0], [*half, 40], about([0, 1, 0], 90))
    shift = np.array([rng.uniform(-0.4, 0.4) * long, 0, 0])
    return open_pair(s, rng, np.array([0, -9, -9.0]), np.array([long, 9, 9]), shift)


def sphere(rng: np.random.Generator) -> Draft:
    s, radius = Structure(), rng.uniform(0.2, 2)
    s.add(BALL, [0, 0, 0], np.full(3, radius))
    if rng.random() < 0.5:
        return open_pair(s, rng, np.full(3, -9.0), np.full(3, 9.0), np.zeros(3))
    views = sensors.all_round(2, rng) + rng.normal(0, 0.3, (2, 3))
    scans = [sensors.object_scan(s.scene, rng, view[None], 90) for view in (views[0], views[0] + 0.4 * views[1])]
    return Draft(scans[0], scans[1], once(), unique=False)


def parallel_walls(rng: np.random.Generator) -> Draft:
    s, long, apart = Structure(), rng.uniform(3, 15, 2) * [1, 0.4], rng.uniform(1.5, 5)
    for y in (-0.05, apart + 0.05):
        s.add(CUBE, [7.5, y, 3], [14, 0.05, 4.5])
    shift = np.array([rng.uniform(-0.4, 0.4) * long[0], 0, rng.uniform(-0.2, 0.2) * long[1]])
    low, high = np.array([0, -0.01, 0]), np.array([long[0], apart + 0.01, long[1]])
    return open_pair(s, rng, low, high, shift)


def slice_scan(s: Structure, rng: np.random.Generator, place: np.ndarray, height: float, reach: float) -> Scan:
    """A 2-D scan: one level revolution at ``height``, written with z = 0."""
    angle = np.linspace(0, 2 * np.pi, int(rng.choice([720, 1080, 1440])), False)
    rays = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], 1)
    at = np.array([*place[:2], height])
    flat = np.array([1, 1, 0])
    return Scan(scenes.scan(s.scene, at, rays, rng, 0.0, reach) * flat, at * flat)


def flat_room(rng: np.random.Generator) -> Draft:
    """2-D scans of a furnished room: one pose is right, in the plane and with it turned over."""
    s = room(rng)
    height = rng.uniform(0.2, 0.7)
    scans = [slice_scan(s, rng, free_place(s.scene, rng), height, BIG) for _ in range(2)]
    check_points(*scans, least=500)
    s.details = list(range(1, len(s.scene.kinds)))
    s.scene.maps = [A * np.array([[1], [1], [100], [1]]) for A in s.scene.maps]  # a slice holds no heights
    s.symmetries += [motion(about(axis, 180)) for axis in np.eye(3)]
    check_unique(s, *scans)
    return Draft(scans[0], scans[1], once(), unique=True, flat=True)


def flat_corridor(rng: np.random.Generator) -> Draft:
    """2-D scans of a bare corridor."""
    s, width, reach = Structure(shells=[0]), rng.uniform(1.5, 3), rng.uniform(8, 20)
    s.box([-100, -width / 2, -1], [100, width / 2, 1])
    places = [np.array([x, rng.uniform(-0.3, 0.3), 0]) for x in (0, rng.uniform(-0.3, 0.3) * reach)]
    scans = [slice_scan(s, rng, place, 0.0, reach) for place in places]
    return Draft(scans[0], scans[1], once(), unique=False, flat=True)


DEGENERATE: dict[str, Maker] = {
    "plane": plane,
    "tunnel": tunnel,
    "sphere": sphere,
    "parallel walls": parallel_walls,
    "2-D room": flat_room,
    "2-D corridor": flat_corridor,
}


# Shy: right, but by little.

CARVED = 0.6  # of the objects have small things all over


def band(make: Callable[[np.random.Generator, float], tuple[Scan, Scan]], low: float, high: float) -> Maker:
    """A maker of pairs with an overlap (the smaller of the two scans' shares) from low to high.

    make(rng, apart) gives two scans, which share the less the larger apart (0 to 1) is.
    """

    def maker(rng: np.random.Generator) -> Draft:
        nearest, farthest = 0.0, 1.0
        for _ in range(6):  # the same scene each time, until the overlap fits
            apart = rng.uniform(nearest, farthest)
            source, target = make(rng, apart)
            share = min(overlap(source.points, target.points))
            if low <= share <= high:
                check_tied(common_cells(source, target))
                return Draft(source, target, once(), unique=True)
            nearest, farthest = (apart, farthest) if share > high else (nearest, apart)
        raise Redraw

    return maker


def room_views(low: float, high: float) -> Maker:
    """Depth camera fragments of a room; what they share holds furniture, not bare walls alone."""

    def maker(rng: np.random.Generator) -> Draft:
        s, heading, views = room(rng), rng.uniform(0, 2 * np.pi), int(rng.integers(2, 5))
        places = [free_place(s.scene, rng, 0.25) for _ in range(2)]
        side = rng.choice([-1, 1])

        def make(rng: np.random.Generator, apart: float) -> tuple[Scan, Scan]:
            scans = []
            for place, angle in zip(places, (heading, heading + side * 2.6 * apart), strict=True):
                towards = [np.cos(angle), np.sin(angle), -0.3]
                scans.append(sensors.camera_scan(s.scene, rng, place, towards, 6.0, views, 64))
            check_points(*scans)
            return scans[0], scans[1]

        draft = band(make, low, high)(rng)
        cells, half = common_cells(draft.source, draft.target), np.diag(s.scene.maps[0])[:3]
        from_walls = half - np.abs(cells - s.scene.maps[0][:3, 3])
        if (from_walls.min(1) > 1.5 * draft.target.size / CELLS).sum() < THINGS:
            raise Redraw
        return draft

    return maker


def street_views(low: float, high: float) -> Maker:
    """LiDAR scans of a street, 5 to 45 m apart."""

    def maker(rng: np.random.Generator) -> Draft:
        scene, reach = scenes.street(rng, 120.0), rng.uniform(25, 45)
        beams, columns = int(rng.choice([32, 48])), int(rng.integers(300, 500))
        first = np.array([rng.uniform(-30, -15), rng.uniform(-1.5, 1.5), 1.9])

        def make(rng: np.random.Generator, apart: float) -> tuple[Scan, Scan]:
            second = first + np.array([5 + 40 * apart, rng.uniform(-1, 1), 0])
            scans = [sensors.lidar_scan(scene, rng, at, reach, beams, columns) for at in (first, second)]
            check_points(*scans)
            return scans[0], scans[1]

        return band(make, low, high)(rng)

    return maker


def carve(s: Structure, rng: np.random.Generator) -> None:
    """Covers an object with small things, as a figure or a casting is."""
    bodies = [A[:3, :4] for A in s.scene.maps]
    for _ in range(rng.integers(20, 80)):
        body, u = bodies[rng.integers(len(bodies))], rng.normal(size=3)
        at = body[:, :3] @ (u / np.linalg.norm(u)) + body[:, 3]  # on a ball's surface, just below a cube's faces
        half = log_uniform(rng, 0.02, 0.08) * rng.uniform(0.5, 1.5, 3)
        s.add(int(rng.choice([CUBE, BALL, CYLINDER])), at, half, Rotation.random(random_state=rng))


def object_views(low: float, high: float) -> Maker:
    """One to three depth views each of an object, from directions 15 to 130 deg apart."""

    def maker(rng: np.random.Generator) -> Draft:
        s, views, width = lump(rng), int(rng.integers(1, 4)), int(log_uniform(rng, 70, 300))
        if rng.random() < CARVED:
            carve(s, rng)
        towards, axis = sensors.all_round(1, rng)[0], sensors.all_round(1, rng)[0]
        axis = np.cross(towards, axis) / np.linalg.norm(np.cross(towards, axis))
        spread = rng.normal(0, 0.25, (2, views, 3)) * (np.arange(views) > 0)[:, None]

        def make(rng: np.random.Generator, apart: float) -> tuple[Scan, Scan]:
            turn = Rotation.from_rotvec(np.radians(15 + 115 * apart) * axis)
            directions = towards + spread[0], turn.apply(towards) + spread[1]
            scans = [sensors.object_scan(s.scene, rng, d, width) for d in directions]
            check_points(*scans, least=400)
            return scans[0], scans[1]

        return band(make, low, high)(rng)

    return maker


def thin(rng: np.random.Generator) -> Draft:
    """A room as 16 beams, or rings far apart, see it."""
    s = room(rng)
    scans = []
    for _ in range(2):
        place = free_place(s.scene, rng, 0.2)
        scans.append(sensors.lidar_scan(s.scene, rng, place, BIG, int(rng.choice([16, 20, 24])), 720))
    check_points(*scans)
    check_tied(common_cells(*scans))
    return Draft(scans[0], scans[1], once(), unique=True)


def few_points(rng: np.random.Generator) -> Draft:
    """300 to 1,500 points of a room or an object."""
    if rng.random() < 0.5:
        s = room(rng)
        pair = room_scans(s, s, rng)
    else:
        pair = object_scans(lump(rng), rng)
    if min(overlap(pair[0].points, pair[1].points)) < 0.6:
        raise Redraw
    scans = [scan.thinned(int(rng.integers(300, 1501)), rng) for scan in pair]
    return Draft(scans[0], scans[1], once(), unique=True)


SHY: dict[str, Maker] = {
    f"{name}, {100 * share[0]:.0f} to {100 * share[1]:.0f} %": maker(*share)
    for name, maker in (("room", room_views), ("street", street_views), ("object", object_views))
    for share in (LOW, HALF)
} | {"thin": thin, "few points": few_points}


# Easy, and pairs of nothing in common.


def whole(rng: np.random.Generator) -> Scan:
    """One scan of a room, a street or an object; none of them maps onto itself."""
    kind = rng.choice(["room", "street", "object", "shape"], p=[0.35, 0.2, 0.25, 0.2])
    if kind == "room":
        s = room(rng)
        sensor = str(rng.choice(["surface", "terrestrial", "camera"]))
        towards = np.array([*rng.normal(size=2), -0.3])
        scan = look(s, sensor, rng, free_place(s.scene, rng), towards, BIG, 1000, facing=False)
    elif kind == "street":
        at = [rng.uniform(-20, 20), rng.uniform(-2, 2), 1.9]
        scan = sensors.lidar_scan(scenes.street(rng, 100.0), rng, at, rng.uniform(30, 60), 64, 500)
    elif kind == "object":
        scan = object_scans(lump(rng), rng)[0]
    else:  # of those that training never sees, without knots, which map onto themselves
        shape = [make for make in shapes.OTHERS if make is not shapes._knot]
        scan = Scan(shape[rng.integers(len(shape))](rng, 12_000))
    check_points(scan, least=2000)
    return scan


def easy(protocol: str) -> Maker:
    """A maker of pairs of one scan: copy, resample, noise, density or overlap, as the benchmarks name them."""

    def maker(rng: np.random.Generator) -> Draft:
        scan = whole(rng)
        points = rng.permutation(scan.points)
        source, target, noise = points[::2], points[1::2], None
        if protocol == "copy":
            source, target, noise = points, points[rng.permutation(len(points))], 0.0
        elif protocol == "noise":
            noise = rng.uniform(0.003, 0.01)
        elif protocol == "density":
            source = source[: max(int(rng.uniform(0.1, 0.5) * len(source)), 500)]
        elif protocol == "overlap":
            share, depth = rng.uniform(0.6, 0.9), points @ sensors.all_round(1, rng)[0]
            low, high = np.quantile(depth, [(1 - share) / (2 - share), 1 / (2 - share)])
            source, target = source[depth[::2] >= low], target[depth[1::2] <= high]
            check_tied(common_cells(Scan(source), Scan(target)))
        return Draft(replace(scan, points=source), replace(scan, points=target), once(), unique=True, noise=noise)

    return maker


def unrelated(rng: np.random.Generator) -> Draft:
    """Scans of two scenes, seven of ten of one size."""
    source, target = whole(rng), whole(rng)
    if rng.random() < 0.7:
        source = Scan(source.points * (target.size / source.size))
    return Draft(source, target, [], unique=False)


EASY: dict[str, Maker] = {
    protocol: easy(protocol) for protocol in ("copy", "resample", "noise", "density", "overlap")
} | {"unrelated": unrelated}
