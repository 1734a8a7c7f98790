"""Pairs of scans of what repeats or is symmetric: with nothing else, and with a detail that tells the poses apart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.synthetic import sensors, structures
from fmr_cli.synthetic.draft import (
    SENSORS,
    Draft,
    Redraw,
    check_points,
    check_tied,
    common_cells,
    log_uniform,
    look,
    several,
    swapped,
    unique,
)
from fmr_cli.synthetic.sensors import Scan
from fmr_cli.synthetic.structures import Structure

BIG = 1e3  # metres: no bound


def wall_scans(
    s: Structure, rng: np.random.Generator, length: float, shift: float, distance: float, height: float
) -> tuple[Scan, Scan]:
    """Scans of a wall along x, the first of x from 0 to length, the second of shift to length + shift."""
    sensor = str(rng.choice(SENSORS, p=[0.4, 0.3, 0.15, 0.15]))
    scans = []
    for low in (0.0, shift):
        stand = np.array([low + length * rng.uniform(0.35, 0.65), -distance * rng.uniform(0.8, 1.2), height])
        scan = look(s, sensor, rng, stand, np.array([0, 1, 0]), BIG, log_uniform(rng, 60, 3000))
        scans.append(scan.within([low, -0.98 * 8, -0.01], [low + length, 0.4, 0.99 * BIG]))
    check_points(*scans)
    return scans[0], scans[1]


def wall(kind: str, extra: str) -> Callable[[np.random.Generator], Draft]:
    """A maker of pairs of a facade or a rack: with nothing else, a "door", "things", or a "door in one"."""

    def make(rng: np.random.Generator) -> Draft:
        length, distance, height = {
            "facade": (rng.uniform(12, 30), rng.uniform(4, 7), 1.8),
            "rack": (rng.uniform(4, 10), rng.uniform(1.6, 2.6), 1.4),
        }[kind]
        shift = length * (rng.uniform(0.28, 0.42) if extra == "door in one" else rng.uniform(0.08, 0.4))
        s = getattr(structures, kind)(rng, -2.0, length + shift + 2)
        width = rng.uniform(0.06, 0.12) * length
        door = np.array([width, rng.uniform(0.035, 0.06) * length, width * rng.uniform(1.2, 2.2)])
        low, high = shift + 0.12 * (length - shift), length - 0.12 * (length - shift)  # well inside both scans
        if extra == "door":
            x = rng.uniform(low, high - width)
            s.box([x, -door[1], 0], [x + width, 0.1, door[2]], detail=True)
        elif extra == "things":
            structures.goods(s, rng, low, high, int(rng.integers(4, 9)))
        elif extra == "door in one":
            x = rng.uniform(length + 0.05 * width, length + shift - 1.1 * width)
            s.box([x, -door[1], 0], [x + width, 0.1, door[2]], detail=True)
        first, second = wall_scans(s, rng, length, shift, distance, height)
        if extra == "door in one":
            draft = several(s, second, first)
            edges = np.array([[x, 0, 0], [x + width, 0, 0]])
            # The other scan has bays where it looked: the door has to stay outside of its view.
            draft.aliases = [S for S in draft.aliases if transform_points(S, edges)[:, 0].min() >= length]
            if len(draft.aliases) < 2:
                raise Redraw
            return draft
        pair = swapped((first, second), rng)
        return several(s, *pair) if not extra else unique(s, *pair)

    return make


def stairs(landing: bool) -> Callable[[np.random.Generator], Draft]:
    def make(rng: np.random.Generator) -> Draft:
        count, apart = int(rng.integers(8, 17)), int(rng.integers(1, 5))
        last = count + apart
        s = structures.stairs(rng, -6, last + 6, last if landing else None)
        tread, rise = s.symmetries[2][1:3, 3]  # one step up
        sensor = str(rng.choice(["surface", "terrestrial", "camera"], p=[0.5, 0.3, 0.2]))
        scans = []
        for begin in (0, apart):
            end = last + 4.0 if landing else begin + count
            low, high = tread * (begin + rng.uniform(0, 1)), tread * (end - rng.uniform(0, 0.9))
            middle = np.array([0.45, (low + high) / 2, rise * (low + high) / 2 / tread])
            stand = middle + np.array([0, -rng.uniform(0.5, 1.5), rng.uniform(1.8, 2.6)])
            scan = look(s, sensor, rng, stand, np.array([0, 1, -0.3]), BIG, log_uniform(rng, 300, 3000))
            scans.append(scan.within([-0.2, low, -BIG], [BIG, high, BIG]))
        check_points(*scans)
        pair = swapped(scans, rng)
        return unique(s, *pair) if landing else several(s, *pair)

    return make


def grid(kind: str, things: bool) -> Callable[[np.random.Generator], Draft]:
    """A maker of pairs of columns or seats, seen from two places."""

    def make(rng: np.random.Generator) -> Draft:
        length = rng.uniform(9, 18) if kind == "columns" else rng.uniform(3.5, 5.5)
        shift = rng.uniform(-0.3, 0.3, 2) * length
        low, high = min(0, *shift) - 1.5, length + max(0, *shift) + 1.5
        s = getattr(structures, kind)(rng, low, high)
        if things:
            inner = np.maximum(shift, 0), length + np.minimum(shift, 0)
            for _ in range(rng.integers(3, 7)):
                half = rng.uniform(0.03, 0.06, 3) * length * [1, 0.7, 1.2]
                at = inner[0] + (inner[1] - inner[0]) * rng.uniform(0.15, 0.85, 2)
                lift = float(np.polyval([s.symmetries[1][2, 3], 0], at[1])) if kind == "seats" else 0.0
                turn = structures.about([0, 0, 1], rng.uniform(0, 90))
                s.add(
                    int(rng.integers(2)),
                    [*at, half[2] + lift + (0.6 if kind == "seats" else 0)],
                    half,
                    turn,
                    detail=True,
                )
        sensor = str(rng.choice(["surface", "terrestrial", "lidar"], p=[0.5, 0.35, 0.15]))
        scans = []
        for corner in (np.zeros(2), shift):
            stand = np.array([*(corner + length * rng.uniform(0.35, 0.65, 2)), rng.uniform(1.5, 2.2)])
            if kind == "seats":
                stand = np.array([corner[0] + length / 2, corner[1] - 0.5, 2.5])
            if any(sensors.inside(A, k, stand[None], 0.2)[0] for k, A in zip(s.scene.kinds, s.scene.maps, strict=True)):
                raise Redraw
            scan = look(s, sensor, rng, stand, np.array([1, 0, 0]), BIG, log_uniform(rng, 60, 3000), facing=False)
            scans.append(scan.within([*corner, -0.01 if kind == "columns" else -4], [*(corner + length), 8]))
        check_points(*scans)
        pair = swapped(scans, rng)
        return unique(s, *pair) if things else several(s, *pair)

    return make


def corridor(equal: bool) -> Callable[[np.random.Generator], Draft]:
    def make(rng: np.random.Generator) -> Draft:
        length = rng.uniform(8, 16)
        shift = length * rng.uniform(0.05, 0.4 if equal else 0.25)
        s = structures.corridor(rng, -6, length + shift + 6, equal)
        sensor = str(rng.choice(["surface", "terrestrial", "lidar"], p=[0.4, 0.4, 0.2]))
        scans = []
        for low in (0.0, shift):
            stand = np.array([low + length * rng.uniform(0.3, 0.7), rng.uniform(-0.3, 0.3), rng.uniform(1.2, 1.8)])
            scan = look(s, sensor, rng, stand, np.array([1, 0, 0]), BIG, log_uniform(rng, 60, 3000), facing=False)
            scans.append(scan.within([low, -BIG, -BIG], [low + length, BIG, BIG]))
        check_points(*scans)
        pair = swapped(scans, rng)
        return several(s, *pair) if equal else unique(s, *pair)

    return make


def pipe(branches: bool) -> Callable[[np.random.Generator], Draft]:
    def make(rng: np.random.Generator) -> Draft:
        length = rng.uniform(2.5, 6)
        shift = length * rng.uniform(0.05, 0.35)
        s = structures.pipe(rng, -1.0, length + shift + 1, branches)
        sensor = str(rng.choice(["surface", "terrestrial"]))
        side = rng.normal(size=2)
        scans = []
        for low in (0.0, shift):
            stand = np.array([low + length / 2, *(2.5 * side / np.linalg.norm(side) + rng.normal(0, 0.3, 2))])
            whole = rng.random() < 0.6
            scan = look(s, sensor, rng, stand, np.array([1, 0, 0]), BIG, log_uniform(rng, 500, 3000), facing=not whole)
            scans.append(scan.within([low, -BIG, -BIG], [low + length, BIG, BIG]))
        check_points(*scans)
        pair = swapped(scans, rng)
        return unique(s, *pair) if branches else several(s, *pair)

    return make


def object_scans(s: Structure, rng: np.random.Generator, sides: bool = False) -> tuple[Scan, Scan]:
    """Two scans of an object all round: evenly sampled, or fused from depth views; ``sides``: of one side only."""
    even = rng.random() < 0.5
    scans = []
    if sides:
        towards, views = sensors.all_round(1, rng), int(rng.integers(1, 4))
        for _ in range(2):
            scans.append(sensors.object_scan(s.scene, rng, towards + rng.normal(0, 0.35, (views, 3)), 90))
        check_points(*scans, least=400)
        return scans[0], scans[1]
    for _ in range(2):
        if even:
            scans.append(sensors.surface_scan(s.scene, rng, log_uniform(rng, 700, 12_000), shells=s.shells))
        else:
            width, views = int(rng.integers(40, 90)), int(rng.integers(7, 12))
            scans.append(sensors.object_scan(s.scene, rng, sensors.all_round(views, rng), width))
    check_points(*scans)
    return scans[0], scans[1]


def part(kind: str, detail: bool) -> Callable[[np.random.Generator], Draft]:
    """A maker of pairs of a gear, flange, table, box or bottle."""

    def make(rng: np.random.Generator) -> Draft:
        s, sides = getattr(structures, kind)(rng, detail), rng.random() < 0.25
        pair = object_scans(s, rng, sides)
        if detail and sides:
            check_tied(common_cells(*pair))
        return (unique if detail else several)(s, *pair)

    return make


MAKERS: dict[str, Callable[[np.random.Generator], Draft]] = {
    "facade": wall("facade", ""),
    "facade, a door in both": wall("facade", "door"),
    "facade, street furniture": wall("facade", "things"),
    "facade, a door in one": wall("facade", "door in one"),
    "stairs, the middle": stairs(False),
    "stairs, a landing": stairs(True),
    "columns": grid("columns", False),
    "columns with things": grid("columns", True),
    "rack": wall("rack", ""),
    "rack with goods": wall("rack", "things"),
    "seats": grid("seats", False),
    "seats with things": grid("seats", True),
    "corridor, doors at equal distances": corridor(True),
    "corridor, doors at unequal distances": corridor(False),
    "pipe": pipe(False),
    "pipe with branches": pipe(True),
    "gear": part("gear", False),
    "gear with a key": part("gear", True),
    "flange": part("flange", False),
    "flange with a key": part("flange", True),
    "table": part("table", False),
    "table with things": part("table", True),
    "box": part("box", False),
    "box with fittings": part("box", True),
    "bottle": part("bottle", False),
    "jug with a handle": part("bottle", True),
}
