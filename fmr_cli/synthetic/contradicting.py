"""Pairs of scans that look alike and contradict each other: mirrored, scaled, of another object, half unexplained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.synthetic import scenes, sensors, structures
from fmr_cli.synthetic.draft import SENSORS, Draft, Redraw, check_points, log_uniform, look, once
from fmr_cli.synthetic.repeating import BIG, object_scans
from fmr_cli.synthetic.scenes import BALL, CUBE, Scene
from fmr_cli.synthetic.sensors import DIFFERENT, Scan, overlap
from fmr_cli.synthetic.structures import Structure

WHOLE = "surface", "terrestrial"  # sensors that see a room all round


def room(rng: np.random.Generator) -> Structure:
    """A furnished room; its walls are solid 0, a shell."""
    return Structure(scenes.room(rng), shells=[0])


def free_place(scene: Scene, rng: np.random.Generator, spread: float = 0.35) -> np.ndarray:
    """A place (3,) in a room at about eye height that nothing stands on, nor closely about."""
    half = np.diag(scene.maps[0])[:2]
    for _ in range(50):
        place = np.array([*(rng.uniform(-1, 1, 2) * 2 * spread * half), rng.uniform(1.1, 1.8)])
        around = place + 0.15 * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        solids = zip(scene.kinds[1:], scene.maps[1:], strict=True)
        if not any(sensors.inside(A, kind, around).any() for kind, A in solids):
            return place
    raise Redraw


def room_scan(s: Structure, rng: np.random.Generator, sensor: str, heading: float) -> Scan:
    towards = np.array([np.cos(heading), np.sin(heading), -0.25])
    return look(s, sensor, rng, free_place(s.scene, rng), towards, BIG, log_uniform(rng, 60, 3000), facing=False)


def room_scans(
    first: Structure, second: Structure, rng: np.random.Generator, by: tuple[str, ...] = SENSORS
) -> tuple[Scan, Scan]:
    """A scan of each room, from places of their own, by the same kind of sensor, looking much the same way."""
    sensor, heading = str(rng.choice(by)), rng.uniform(0, 2 * np.pi)
    scans = room_scan(first, rng, sensor, heading), room_scan(second, rng, sensor, heading + rng.normal(0, 0.2))
    check_points(*scans)
    return scans


def lump(rng: np.random.Generator) -> Structure:
    """An object of about 1 m that is not its own mirror image: five to nine solids off in unlike directions."""
    s = Structure()
    s.add(CUBE, [0, 0, 0], rng.uniform(0.15, 0.35, 3), Rotation.random(random_state=rng))
    arms = Rotation.random(random_state=rng).apply(np.eye(3) * rng.permutation([0.3, 0.42, 0.56])[:, None])
    arms = [*(arms + rng.normal(0, 0.1, (3, 3))), *rng.normal(0, 0.3, (int(rng.integers(1, 6)), 3))]
    for arm in arms:
        half = np.exp(rng.uniform(np.log(0.08), np.log(0.26), 3))
        s.add(int(rng.integers(3)), arm, half, Rotation.random(random_state=rng))
    return s


def chair(rng: np.random.Generator) -> Structure:
    """A chair with its back at greater y, some with arms."""
    s = Structure()
    w, d, h, back, leg = rng.uniform([0.18, 0.18, 0.3, 0.15, 0.015], [0.35, 0.35, 0.7, 0.5, 0.04])
    s.box([-w, -d, h], [w, d, h + 0.05])
    s.box([-w, d - 0.06, h], [w, d, h + 2 * back])
    for x in (-1, 1):
        for y in (-1, 1):
            s.box([x * (w - leg) - leg, y * (d - leg) - leg, 0], [x * (w - leg) + leg, y * (d - leg) + leg, h])
    if rng.random() < 0.5:
        for x in (-1, 1):
            s.box([x * w - 0.03, -d, h + 0.2], [x * w + 0.03, d, h + 0.25])
    return s


def mirrored(scan: Scan) -> Scan:
    """The mirror image of a scan, by x."""
    flip = np.array([-1.0, 1, 1])
    return Scan(scan.points * flip, None if scan.origin is None else scan.origin * flip, scan.stray * flip)


def mirrored_room(rng: np.random.Generator) -> Draft:
    """Scans of a whole room, one of them mirrored; what stands in it is not where its mirror image would be."""
    s = room(rng)
    scans = room_scans(s, s, rng, WHOLE)
    source, target = scans[0], mirrored(scans[1])
    for turn in (Rotation.identity(), Rotation.from_euler("z", np.pi)):  # the walls go onto themselves
        if min(overlap(turn.apply(source.points), target.points, DIFFERENT * target.size)) > 0.85:
            raise Redraw
    return Draft(source, target, [], unique=False)


def mirrored_object(rng: np.random.Generator) -> Draft:
    source, target = object_scans(lump(rng), rng)
    target = mirrored(target)
    # Not even turned about the axes of inertia may it lie on itself.
    for turn in Rotation.create_group("D2"):
        frames = [np.linalg.eigh(np.cov(scan.points.T))[1] for scan in (source, target)]
        frames = [F * [1, 1, np.linalg.det(F)] for F in frames]
        moved = [(scan.points - scan.points.mean(0)) @ F for scan, F in zip((source, target), frames, strict=True)]
        if min(overlap(turn.apply(moved[0]), moved[1], DIFFERENT * source.size)) > 0.8:
            raise Redraw
    return Draft(source, target, [], unique=False)


def scaled(make: Callable[[np.random.Generator], Structure]) -> Callable[[np.random.Generator], Draft]:
    """A maker of pairs of which one is 3 to 10 % too large."""

    def maker(rng: np.random.Generator) -> Draft:
        s = make(rng)
        source, target = room_scans(s, s, rng) if s.shells else object_scans(s, rng)
        factor = rng.uniform(1.03, 1.1) ** rng.choice([-1, 1])
        origin = None if source.origin is None else source.origin * factor
        return Draft(replace(source, points=source.points * factor, origin=origin), target, [], unique=False)

    return maker


def relative(rng: np.random.Generator) -> Draft:
    """Two objects of one family, of one size, of other proportions."""
    makers: list[Callable[[np.random.Generator], Structure]] = [
        chair,
        lambda r: structures.table(r, False),
        lambda r: structures.flange(r, False),
        lambda r: structures.gear(r, False),
        lambda r: structures.bottle(r, False),
    ]
    make = makers[rng.integers(len(makers))]
    source, target = object_scans(make(rng), rng)[0], object_scans(make(rng), rng)[0]
    factor = target.size / source.size
    source = Scan(source.points * factor)
    aligned = (
        source.points - (source.points.max(0) + source.points.min(0) - target.points.max(0) - target.points.min(0)) / 2
    )
    if min(min(overlap(points, target.points, DIFFERENT * target.size)) for points in (source.points, aligned)) > 0.75:
        raise Redraw  # as good as the same
    return Draft(source, target, [], unique=False)


def moved_furniture(rng: np.random.Generator) -> Draft:
    """The same room after two to four of its things were moved: still one pose is right."""
    before = room(rng)
    after = room(rng)
    after.scene = Scene(list(before.scene.kinds), [A.copy() for A in before.scene.maps])
    last = np.arange(max(len(after.scene.kinds) - 6, 7), len(after.scene.kinds))
    for i in rng.permutation(last)[: int(rng.integers(2, 5))]:
        turn, A = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix(), after.scene.maps[i]
        A[:3, :3] = turn @ A[:3, :3]
        A[:2, 3] = rng.uniform(-0.7, 0.7, 2) * np.diag(before.scene.maps[0])[:2]
    source, target = room_scans(before, after, rng)
    if min(overlap(source.points, target.points)) < 0.5:
        raise Redraw
    return Draft(source, target, once(), unique=True)


def half_unexplained(rng: np.random.Generator) -> Draft:
    """Two things that share a face and the block behind it, and nothing else."""
    half = np.array([rng.uniform(0.4, 0.8), rng.uniform(0.25, 0.5), rng.uniform(0.03, 0.3)])
    scans = []
    for _ in range(2):
        s = Structure()
        s.add(CUBE, [0, 0, -half[2]], half)
        for _ in range(rng.integers(3, 7)):
            size = rng.uniform(0.12, 0.32, 3)
            place = [*(rng.uniform(-0.8, 0.8, 2) * half[:2]), size[2] * rng.uniform(0.6, 1)]
            s.add(int(rng.choice([CUBE, BALL, 2])), place, size, Rotation.from_rotvec(rng.normal(0, 0.3, 3)))
        scans.append(object_scans(s, rng)[0])
    if not 0.25 < min(overlap(scans[0].points, scans[1].points, DIFFERENT * scans[0].size)) < 0.65:
        raise Redraw
    return Draft(scans[0], scans[1], [], unique=False)


MAKERS: dict[str, Callable[[np.random.Generator], Draft]] = {
    "mirrored room": mirrored_room,
    "mirrored object": mirrored_object,
    "scaled object": scaled(lump),
    "scaled room": scaled(room),
    "another of the family": relative,
    "furniture moved": moved_furniture,
    "half unexplained": half_unexplained,
}
