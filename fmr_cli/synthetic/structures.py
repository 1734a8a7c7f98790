"""Scenes that map onto themselves: facades, stairs, columns, racks, seats, corridors, pipes, gears, tables, boxes.

Each comes with the motions that map it onto itself, were it endless, and with the solids that break them. Metres, z up.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fmr_cli.synthetic.scenes import BALL, CUBE, CYLINDER, Scene

TURNS = 120  # listed of a continuous rotation: three degrees apart, so that none is more than 1.5 deg off


@dataclass
class Structure:
    """A scene and its symmetries.

    symmetries: motions (4, 4) of the scene's frame that map it, without its details, onto itself; the identity first.
    turns: the same of a body of revolution, each of which may follow any of the former.
    details: solids that break them all. shells: solids that are seen from within.
    """

    scene: Scene = field(default_factory=Scene)
    symmetries: list[np.ndarray] = field(default_factory=lambda: [np.eye(4)])
    turns: list[np.ndarray] = field(default_factory=lambda: [np.eye(4)])
    details: list[int] = field(default_factory=list)
    shells: list[int] = field(default_factory=list)

    def add(
        self, kind: int, centre: ArrayLike, half: ArrayLike, turn: Rotation | None = None, *, detail: bool = False
    ) -> None:
        """A solid; ``detail``: one that breaks the symmetries."""
        if detail:
            self.details.append(len(self.scene.kinds))
        self.scene.add(kind, centre, half, turn)

    def box(self, low: ArrayLike, high: ArrayLike, *, detail: bool = False) -> None:
        """A cuboid between two corners."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        self.add(CUBE, (low + high) / 2, (high - low) / 2, detail=detail)


def motion(turn: Rotation | None = None, shift: ArrayLike = (0, 0, 0), centre: ArrayLike = (0, 0, 0)) -> np.ndarray:
    """(4, 4): a rotation about ``centre``, then a shift."""
    T, centre = np.eye(4), np.asarray(centre, float)
    if turn is not None:
        T[:3, :3] = turn.as_matrix()
    T[:3, 3] = centre - T[:3, :3] @ centre + np.asarray(shift, float)
    return T


def steps(count: int) -> list[int]:
    """0, 1, -1, 2, -2 ... count, -count: shifts by whole periods, the identity first."""
    return [0] + [sign * k for k in range(1, count + 1) for sign in (1, -1)]


def about(axis: ArrayLike, degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis, float))


def products(left: Iterable[np.ndarray], right: Iterable[np.ndarray]) -> list[np.ndarray]:
    return [a @ b for a, b in itertools.product(left, right)]


def facade(rng: np.random.Generator, low: float, high: float) -> Structure:
    """A wall along x, seen from y < 0, with equal bays from low to high: windows that stand out, sills, pilasters."""
    s, period, floors = Structure(), rng.uniform(2.2, 6.0), int(rng.integers(1, 4))
    storey = rng.uniform(2.8, 3.6)
    s.box([low, 0, 0], [high, 1, floors * storey])
    s.box([low, -8, -1], [high, 0.5, 0])
    parts = []
    for floor in range(floors):
        base = floor * storey
        for _ in range(rng.integers(1, 3)):
            x, z = rng.uniform(0, 0.5) * period, base + rng.uniform(0.3, 1.2)
            size = [rng.uniform(0.2, 0.45) * period, rng.uniform(0.15, 0.6), rng.uniform(0.4, 0.5) * storey]
            parts.append((CUBE, [x, -size[1], z], size))
    if rng.random() < 0.5:
        width = rng.uniform(0.2, 0.5)
        kind = CYLINDER if rng.random() < 0.3 else CUBE
        parts.append((kind, [0.8 * period, -width, 0], [width, 2 * width, floors * storey]))
    for k in range(int(np.floor(low / period)), int(np.ceil(high / period))):
        for kind, corner, size in parts:
            half = np.array(size) / 2
            s.add(kind, np.array(corner) + half + [k * period, 0, 0], half)
    s.symmetries = [motion(shift=[k * period, 0, 0]) for k in steps(int(30 / period))]
    return s


def stairs(rng: np.random.Generator, first: int, last: int, landing: int | None = None) -> Structure:
    """Steps along y, numbered first to last, seen from above; a landing after step ``landing`` if given."""
    s = Structure()
    tread, rise, width = rng.uniform(0.24, 0.36), rng.uniform(0.14, 0.2), rng.uniform(0.9, 2.4)
    wall = rng.random() < 0.5
    ends = range(first, last if landing is None else landing + 1)
    for k in ends:  # each goes three steps back and down, so that the lower ones' hidden faces lie inside
        s.box([0, k * tread, (k - 3) * rise], [width, (k + 3) * tread, (k + 1) * rise])
    if landing is not None:
        y, z = (landing + 1) * tread, (landing + 1) * rise
        s.box([0, y - tread, z - 3 * rise], [width, y + rng.uniform(1.0, 1.6), z], detail=True)
        if rng.random() < 0.5:
            s.box([0.1, y + 0.3, z], [0.1 + rng.uniform(0.2, 0.6), y + rng.uniform(0.6, 0.9), z + 0.9], detail=True)
    if wall:  # along the slope, so that a step's shift maps it onto itself too
        half_way, slope = (first + last) / 2, np.arctan2(rise, tread)
        long = ((last - first) / 2 + 5) * np.hypot(tread, rise)
        s.add(
            CUBE, [-0.5, half_way * tread, (half_way + 0.5) * rise], [0.5, long, 1.5], Rotation.from_euler("x", slope)
        )
    shifts = [motion(shift=[0, k * tread, k * rise]) for k in steps(last - first)]
    # A zigzag line is its own image under a half turn about the middle of a tread. Only who knows which side is the
    # upper one can tell.
    middle = [width / 2, 0.5 * tread, rise]
    s.symmetries = products(shifts, [np.eye(4), motion(about([1, 0, 0], 180), centre=middle)])
    return s


def columns(rng: np.random.Generator, low: float, high: float) -> Structure:
    """Columns on a grid over a floor, x and y from low to high, with or without a ceiling."""
    s = Structure()
    px, py = rng.uniform(2.5, 6, 2)
    square, ceiling = rng.random() < 0.3, rng.random() < 0.3
    px, py = (px, px) if square else (px, max(py, px + 0.6))
    height, radius, kind = rng.uniform(2.4, 4), rng.uniform(0.15, 0.45), rng.choice([CUBE, CYLINDER])
    s.box([low, low, -1], [high, high, 0])
    if ceiling:
        s.box([low, low, height], [high, high, height + 1])
    for i in range(int(np.ceil(low / px)), int(high / px) + 1):
        for j in range(int(np.ceil(low / py)), int(high / py) + 1):
            s.add(int(kind), [i * px, j * py, height / 2], [radius, radius, height / 2])
    turns = [motion(about([0, 0, 1], a)) for a in ((0, 90, 180, 270) if square else (0, 180))]
    if ceiling:
        turns = products(turns, [np.eye(4), motion(about([1, 0, 0], 180), centre=[0, 0, height / 2])])
    shifts = [motion(shift=[i * px, j * py, 0]) for i in steps(int(8 / px)) for j in steps(int(8 / py))]
    s.symmetries = products(shifts, turns)
    return s


def rack(rng: np.random.Generator, low: float, high: float) -> Structure:
    """Shelves along x before a wall, seen from y < 0: bays of uprights and boards."""
    s = Structure()
    bay, depth, levels = rng.uniform(0.8, 2.7), rng.uniform(0.3, 1.0), int(rng.integers(3, 6))
    pitch, thick = rng.uniform(0.35, 0.6), rng.uniform(0.03, 0.06)
    s.box([low, 0, 0], [high, 0.5, levels * pitch + rng.uniform(0.2, 0.8)])
    s.box([low, -3, -0.5], [high, 0.2, 0])
    for level in range(1, levels + 1):
        s.box([low, -depth, level * pitch - thick], [high, 0.1, level * pitch])
    wide = rng.uniform(0.05, 0.12)
    for k in range(int(np.ceil(low / bay)), int(high / bay) + 1):
        s.box([k * bay - wide, -depth - 0.02, 0], [k * bay + wide, 0.1, levels * pitch])
    s.symmetries = [motion(shift=[k * bay, 0, 0]) for k in steps(int(8 / bay))]
    return s


def goods(s: Structure, rng: np.random.Generator, low: float, high: float, count: int) -> None:
    """Things before a wall along x, from low to high: unequal boxes, barrels and balls, as details."""
    for x in rng.uniform(low, high, count):
        half = rng.uniform(0.03, 0.075, 3) * (high - low) * [1, 0.7, 1.5]
        at = [x, -rng.uniform(1.0, 2.0) * half[1], half[2] + rng.choice([0, rng.uniform(0, 1)])]
        s.add(int(rng.integers(3)), at, half, Rotation.from_euler("z", rng.normal(0, 0.3)), detail=True)


def seats(rng: np.random.Generator, low: float, high: float) -> Structure:
    """Rows of seats, x and y from low to high, on a floor or rising in steps; their backs are at greater y."""
    s = Structure()
    px, py, rise = rng.uniform(0.55, 0.8), rng.uniform(0.9, 1.3), rng.choice([0, rng.uniform(0.1, 0.4)])
    width, high_seat, back = rng.uniform(0.4, 0.5), rng.uniform(0.38, 0.48), rng.uniform(0.4, 0.6)
    rows = range(int(np.floor(low / py)), int(np.ceil(high / py)))
    for j in rows:
        s.box([low, j * py, -9], [high, (rows[-1] + 2) * py if rise else (j + 1.01) * py, j * rise])
        for i in range(int(np.floor(low / px)), int(np.ceil(high / px))):
            x, y, z = i * px, j * py + 0.3, j * rise
            s.box([x, y, z + high_seat - 0.1], [x + width, y + 0.45, z + high_seat])
            s.box([x, y + 0.4, z + high_seat - 0.1], [x + width, y + 0.48, z + high_seat + back])
    s.symmetries = [motion(shift=[i * px, j * py, j * rise]) for i in steps(int(3 / px)) for j in steps(int(3 / py))]
    return s


def corridor(rng: np.random.Generator, low: float, high: float, equal: bool) -> Structure:
    """A corridor along x with doorways that stand out from one wall or both: at equal distances or at unequal ones."""
    s = Structure()
    width, height = rng.uniform(1.8, 3.5), rng.uniform(2.4, 3.2)
    s.shells = [0]
    s.box([low - 2, -width / 2, 0], [high + 2, width / 2, height])
    period, deep = rng.uniform(1.8, 4.5), rng.uniform(0.2, 0.5)
    door = np.array([rng.uniform(0.8, 1.3), deep, rng.uniform(1.9, 2.2)])
    both = rng.random() < 0.5
    x = low
    while x < high:
        for side in (-1, 1) if both and equal else (1,) if equal else (rng.choice([-1, 1]),):
            y = side * (width / 2 - deep / 2)
            s.add(
                CUBE, [x + door[0] / 2, y, door[2] / 2], [door[0] / 2, deep / 2 + 0.01, door[2] / 2], detail=not equal
            )
        x += period if equal else door[0] + rng.choice([0.3, 0.9, 1.6, 2.4, 3.3]) + rng.uniform(-0.1, 0.1)
    if not equal:  # a bare corridor maps onto itself at any shift; the likeliest to mislead bring a door onto a door
        doors = [s.scene.maps[i][0, 3] for i in s.details]
        s.symmetries += [motion(shift=[b - a, 0, 0]) for a, b in itertools.permutations(doors, 2)]
        s.symmetries += [
            motion(about([0, 0, 1], 180), centre=[(a + b) / 2, 0, 0])
            for a, b in itertools.combinations_with_replacement(doors, 2)
        ]
        return s
    turns = [np.eye(4)]
    if both:
        # About a door near the middle, so that the shifts reach all that are about another one.
        middle = low + door[0] / 2 + period * round((high - low) / 2 / period)
        turns.append(motion(about([0, 0, 1], 180), centre=[middle, 0, 0]))
    s.symmetries = products([motion(shift=[k * period, 0, 0]) for k in steps(int(15 / period))], turns)
    return s


def pipe(rng: np.random.Generator, low: float, high: float, branches: bool) -> Structure:
    """A pipe along x with collars at equal distances; ``branches``: others leave it on several sides."""
    s, along = Structure(), about([0, 1, 0], 90)
    radius, period = rng.uniform(0.1, 0.3), rng.uniform(0.6, 1.5)
    s.add(CYLINDER, [(low + high) / 2, 0, 0], [radius, radius, (high - low) / 2 + 5], along)
    collar = [radius * rng.uniform(1.3, 1.7)] * 2 + [rng.uniform(0.04, 0.12)]
    for k in range(int(np.ceil(low / period)), int(high / period) + 1):
        s.add(CYLINDER, [k * period, 0, 0], collar, along)
    if branches:
        middle = (low + high) / 2 + rng.uniform(-0.1, 0.1) * (high - low)
        for x, angle in ((0, 0), (rng.uniform(0.4, 0.9), rng.uniform(50, 130)), (-rng.uniform(0.3, 0.9), 200)):
            half = [radius * rng.uniform(0.5, 0.9)] * 2 + [rng.uniform(2.5, 5) * radius]
            turn = about([1, 0, 0], angle)
            s.add(CYLINDER, [middle + x, *turn.apply([0, 0, half[2]])[1:]], half, turn, detail=True)
        s.box([middle - 0.2, -2.5 * radius, -radius], [middle + 0.25, -radius, 0.8 * radius], detail=True)
    s.turns = [motion(about([1, 0, 0], 360 * i / TURNS)) for i in range(TURNS)]
    flips = [np.eye(4), motion(about([0, 0, 1], 180))]
    shifts = [motion(shift=[k * period, 0, 0]) for k in steps(int(0.7 * (high - low) / period))]
    s.symmetries = products(shifts, flips)
    return s


def gear(rng: np.random.Generator, key: bool) -> Structure:
    """A wheel of equal teeth, the same from both sides; ``key``: a boss on one side, off the centre."""
    s, teeth = Structure(), int(rng.integers(5, 25))
    radius, thick = rng.uniform(0.3, 0.6), rng.uniform(0.05, 0.2)
    long, wide = rng.uniform(0.12, 0.25) * radius, rng.uniform(0.35, 0.6) * np.pi * radius / teeth
    s.add(CYLINDER, [0, 0, 0], [radius, radius, thick])
    for i in range(teeth):
        turn = about([0, 0, 1], 360 * i / teeth)
        s.add(CUBE, turn.apply([radius + 0.3 * long, 0, 0]), [0.8 * long, wide, 0.999 * thick], turn)
    if rng.random() < 0.6:
        s.add(CYLINDER, [0, 0, 0], [0.3 * radius, 0.3 * radius, thick * rng.uniform(1.2, 2.5)])
    if key:
        size = rng.uniform(0.14, 0.25) * radius
        s.add(int(rng.choice([CUBE, CYLINDER])), [0.62 * radius, 0, thick], [size, 0.8 * size, 1.5 * size], detail=True)
    turns = [motion(about([0, 0, 1], 360 * i / teeth)) for i in range(teeth)]
    s.symmetries = products(turns, [np.eye(4), motion(about([1, 0, 0], 180))])
    return s


def flange(rng: np.random.Generator, key: bool) -> Structure:
    """A disc with a neck and equal bolts on one side; ``key``: one more thing between two of them."""
    s, bolts = Structure(), int(rng.integers(3, 13))
    radius, thick = rng.uniform(0.3, 0.6), rng.uniform(0.03, 0.1)
    s.add(CYLINDER, [0, 0, 0], [radius, radius, thick])
    neck = rng.uniform(0.3, 0.5) * radius
    s.add(CYLINDER, [0, 0, thick], [neck, neck, rng.uniform(0.1, 0.5)])
    size = min(0.12 * radius, 0.25 * 2 * np.pi * 0.8 * radius / bolts)
    for i in range(bolts):
        s.add(CYLINDER, about([0, 0, 1], 360 * i / bolts).apply([0.8 * radius, 0, thick]), [size, size, 1.5 * size])
    if key:
        turn, half = about([0, 0, 1], 180 / bolts), radius * np.array([0.16, 0.12, 0.2])
        s.add(CUBE, turn.apply([0.72 * radius, 0, thick + half[2] / 2]), half, turn, detail=True)
    s.symmetries = [motion(about([0, 0, 1], 360 * i / bolts)) for i in range(bolts)]
    return s


def table(rng: np.random.Generator, things: bool) -> Structure:
    """A table of two, four or n equal sides or a round one, with or without things on it."""
    s, height, leg = Structure(), rng.uniform(0.4, 0.9), rng.uniform(0.02, 0.05)
    legs, style = 4, rng.choice(["oblong", "square", "round"])
    half = np.array([rng.uniform(0.45, 1.1), rng.uniform(0.3, 0.4), 0.02])
    if style == "square":
        half[1] = half[0]
    if style == "round":
        legs, half[1] = int(rng.integers(3, 7)), half[0]
        s.add(CYLINDER, [0, 0, height], half)
        for i in range(legs):
            foot = about([0, 0, 1], 360 * i / legs).apply([0.8 * half[0], 0, height / 2])
            s.add(CYLINDER, foot, [leg, leg, height / 2])
    else:
        s.add(CUBE, [0, 0, height], half)
        for x, y in itertools.product((-1, 1), repeat=2):
            s.add(CUBE, [x * (half[0] - leg), y * (half[1] - leg), height / 2], [leg, leg, height / 2])
    if things:
        for at in ((0.55, 0.3), (-0.3, -0.5), (0.1, 0.5))[: int(rng.integers(2, 4))]:
            thing = rng.uniform(0.08, 0.14, 3) * (half[0] + half[1]) * [1, 0.7, 1.5]
            place = [at[0] * half[0], at[1] * half[1], height + half[2] + thing[2]]
            s.add(int(rng.choice([CUBE, CYLINDER])), place, thing, about([0, 0, 1], rng.uniform(0, 90)), detail=True)
    fold = {"oblong": 2, "square": 4, "round": legs}[str(style)]
    s.symmetries = [motion(about([0, 0, 1], 360 * i / fold)) for i in range(fold)]
    return s


def box(rng: np.random.Generator, things: bool) -> Structure:
    """A cuboid, a square prism or a cube; ``things``: a handle and a lid's knob, unlike each other."""
    s, half = Structure(), np.sort(rng.uniform(0.15, 0.6, 3)) * [0.8, 1.0, 1.25]
    equal = int(rng.integers(3))
    if equal:
        half[: equal + 1] = half[0]
    s.add(CUBE, [0, 0, 0], half)
    if things:
        thing = rng.uniform(0.15, 0.25, 3) * half[0] + 0.12 * half[2]
        s.add(CUBE, [0.3 * half[0], half[1], 0.4 * half[2]], thing, detail=True)
        s.add(CYLINDER, [half[0], -0.4 * half[1], -0.3 * half[2]], np.full(3, thing.mean()), detail=True)
    # The 24 turns of a cube are those of its axes; a longer one may only go onto one as long.
    every = Rotation.create_group("O")
    turns = [t for t in every if np.allclose(np.abs(t.as_matrix()) @ half, half)]
    s.symmetries = sorted((motion(t) for t in turns), key=lambda T: -np.trace(T))
    return s


def bottle(rng: np.random.Generator, handle: bool) -> Structure:
    """A body of revolution; ``handle``: with a handle and a spout."""
    s, z, low = Structure(), 0.0, rng.uniform(0.12, 0.25)
    radius = low
    for _ in range(rng.integers(2, 5)):
        radius, half = low * rng.uniform(0.35, 1.2), rng.uniform(0.06, 0.25)
        s.add(CYLINDER, [0, 0, z + half], [radius, radius, half])
        z += 2 * half
    if rng.random() < 0.5:  # a round stopper
        s.add(BALL, [0, 0, z], [0.8 * radius, 0.8 * radius, radius * rng.uniform(0.5, 1.2)])
    if handle:
        s.add(CUBE, [1.25 * low, 0, 0.5 * z], [0.5 * low, 0.12 * low, 0.3 * z], detail=True)
        s.add(CYLINDER, [-0.4 * low, 1.1 * low, 0.3 * z], [0.25 * low, 0.5 * low, 0.1 * z], detail=True)
    s.turns = [motion(about([0, 0, 1], 360 * i / TURNS)) for i in range(TURNS)]
    return s
