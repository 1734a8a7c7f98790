"""What tells a pose from rivals that fit as well: a door in a row of equal bays, that lies on the other scan's door."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli import PointCloud
from fmr_cli.registration.confidence import BARE, DETAIL, IF_BARE, TOLD, Judge, detail_log, told
from fmr_cli.registration.distinction import explained_points, stands_out, thing
from fmr_cli.registration.looks import FINE
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.pipeline import one_blas_thread
from fmr_cli.registration.prepared import Prepared

BAY = 3.0  # m
FAR = 21.0  # m along the wall: shifted so far, what lies amid a scan lies beyond the other one's end
DENSITY = 250.0  # points per m²


def panel(rng: np.random.Generator, corner: list[float], u: list[float], v: list[float]) -> np.ndarray:
    """Points of a parallelogram from a corner along u and v."""
    size = np.linalg.norm(np.cross(u, v))
    a, b = rng.random((2, int(size * DENSITY), 1))
    return corner + a * u + b * v


def bump(rng: np.random.Generator, x: float, low: float, size: tuple[float, float, float]) -> np.ndarray:
    """The front and sides of a box before the wall y = 0, from x and height low on."""
    w, d, h = size
    return np.concatenate(
        [
            panel(rng, [x, -d, low], [w, 0, 0], [0, 0, h]),
            panel(rng, [x, -d, low], [0, d, 0], [0, 0, h]),
            panel(rng, [x + w, -d, low], [0, d, 0], [0, 0, h]),
            panel(rng, [x, -d, low + h], [w, 0, 0], [0, d, 0]),
        ]
    )


def facade(seed: int, start: float, end: float, doors: list[float]) -> np.ndarray:
    """A wall with ground before it and a pillar in each bay, from start to end along x, m; doors between some."""
    rng = np.random.default_rng(seed)
    parts = [
        panel(rng, [start, 0, 0], [end - start, 0, 0], [0, 0, 6]),
        panel(rng, [start, -5, 0], [end - start, 0, 0], [0, 5, 0]),
        *(
            bump(rng, x, 0.0, (0.8, 1.0, 5.0))
            for x in np.arange(np.ceil(start / BAY), end // BAY + 1) * BAY
            if x + 0.8 < end
        ),
        *(bump(rng, x, 0.0, (1.5, 0.6, 2.5)) for x in doors),
    ]
    x = np.concatenate(parts)
    return x + rng.normal(0, 2e-3, x.shape)


def judged(source: np.ndarray, target: np.ndarray, shifts: list[float]) -> Judge:
    """Poses between two facades in one frame, shifted along it from the right one."""
    with one_blas_thread():
        pair = make_pair(Prepared(PointCloud(source)), Prepared(PointCloud(target)), Options(), 1, *FINE)
        judge = Judge(pair)
        for shift in shifts:
            T = np.eye(4)
            T[0, 3] = shift
            judge.consider(pair.enter_centred(T), "features", [])
    return judge


@pytest.mark.parametrize(
    ("in_source", "in_target", "tells"),
    [([16.0], [16.0], True), ([], [], False), ([16.0], [], False), ([16.0, 28.0], [16.0, 7.0], False)],
    ids=["a door in both", "no door", "a door in one", "far off, a door meets a door as well"],
)
def test_a_thing_tells_the_pose_that_brings_it_onto_its_like(
    in_source: list[float], in_target: list[float], tells: bool
) -> None:
    source, target = facade(1, 7, 31, in_source), facade(2, 0, 24, in_target)
    assert stands_out(judged(source, target, [0.0, -FAR, 2 * BAY, -BAY])) == tells


def test_a_pose_of_the_like_is_contradicted_by_the_thing_that_the_best_one_explains() -> None:
    judge = judged(facade(1, 7, 31, [16.0]), facade(2, 0, 24, [16.0]), [0.0, -BAY])
    best, shifted = judge.candidates
    there = thing(judge.pair, shifted)
    assert there.sum() == shifted.evidence.largest
    assert (there & explained_points(judge.pair, best)).sum() > there.sum() / 2
    pair = judge.pair
    x = np.concatenate([pair.source.frame.leave(pair.s.points), pair.target.frame.leave(pair.t.points)])[there][:, 0]
    assert ((x > 15) & (x < 19)).all()  # where the door is, but for its edges


def test_what_bounds_a_confidence_bounds_that_of_a_pose_told_apart_too() -> None:
    x = judged(facade(1, 7, 31, [16.0]), facade(2, 0, 24, [16.0]), [0.0]).best.evidence.vector()
    assert told(0.3, x) == pytest.approx(TOLD * 0.3 / (0.7 + TOLD * 0.3))
    x[DETAIL] = detail_log(BARE - 1)
    assert told(0.3, x) == IF_BARE
