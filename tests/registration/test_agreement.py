"""What two surfaces say of a pose: made-up walls with boxes on them, sampled anew for each scan."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.geometry.surface import Surface
from fmr_cli.registration.agreement import Agreement, agreement

EDGE = 0.2


def sheet(corner: list[float], u: list[float], v: list[float], rng: np.random.Generator) -> np.ndarray:
    """A parallelogram of 200 random points a square unit."""
    one, other = np.array(u), np.array(v)
    count = int(200 * np.linalg.norm(np.cross(one, other)))
    return np.array(corner) + rng.random((count, 1)) * one + rng.random((count, 1)) * other


def box(x: float, rng: np.random.Generator, depth: float = 0.4) -> np.ndarray:
    """What stands out from the wall y = 0 between x and x + 1.5: a front and four sides."""
    along, out, up = [1.5, 0.0, 0.0], [0.0, -depth, 0.0], [0.0, 0.0, 1.5]
    return np.vstack([
        sheet([x, -depth, 1], along, up, rng), sheet([x, 0, 1], out, up, rng), sheet([x + 1.5, 0, 1], out, up, rng),
        sheet([x, 0, 1], along, out, rng), sheet([x, 0, 2.5], along, out, rng),
    ])  # fmt: skip


def wall(low: float, high: float, seed: int, *more: np.ndarray) -> Surface:
    """A wall along x with boxes every 3 units, from ``low`` to ``high``: the border cuts through what is there."""
    rng = np.random.default_rng(seed)
    parts = [sheet([0, 0, 0], [24, 0, 0], [0, 0, 4], rng), *(box(x, rng) for x in range(1, 24, 3)), *more]
    points = np.vstack(parts)
    return Surface(points[(points[:, 0] >= low) & (points[:, 0] <= high)], EDGE)


def seen(source: Surface, target: Surface, shift: float = 0.0) -> Agreement:
    T = np.eye(4)
    T[0, 3] = shift
    return agreement(source, target, T)


@pytest.mark.parametrize("border", [16.0, 16.6])  # at a box's side, and through its middle
def test_where_a_scan_ends_nothing_contradicts_what_the_other_one_saw_beyond(border: float) -> None:
    found = seen(wall(5.5, 24, 1), wall(0, border, 2))
    assert found.contradicted < 0.01 * found.explained
    assert 0.5 < found.explained_share < 0.75


def test_what_only_one_of_two_scans_has_contradicts() -> None:
    thing = box(12.1, np.random.default_rng(3), depth=0.8)
    with_it, without = seen(wall(0, 24, 1, thing), wall(0, 24, 2)), seen(wall(0, 24, 1), wall(0, 24, 2))
    assert with_it.contradicted > without.contradicted + 20  # of about 60 voxels of its front


def test_a_pose_off_by_a_part_of_a_period_is_contradicted_and_a_whole_one_is_not() -> None:
    source, target = wall(0, 24, 1), wall(0, 24, 2)
    part, whole = seen(source, target, 1.5), seen(source, target, 3.0)
    assert part.contradicted > 5 * whole.contradicted
    assert whole.explained > part.explained


def test_what_stands_out_from_a_wall_is_detail() -> None:
    assert seen(wall(0, 24, 1), wall(0, 24, 2)).detail > 300
