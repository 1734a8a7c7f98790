"""What two scans say about the certainty of their pose."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.geometry import observability
from fmr_cli.geometry.point_to_plane import point_to_plane, step_motion
from fmr_cli.geometry.sampling import working_scale
from fmr_cli.geometry.se3 import adjoint, exp, log
from fmr_cli.geometry.surface import Surface

Scans = tuple[np.ndarray, np.ndarray]
EDGE = 0.08  # of the voxels, metres


def grid(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.meshgrid(u, v)
    return a.ravel(), b.ravel()


def plane() -> np.ndarray:
    x, y = grid(np.arange(-2, 2, 0.04), np.arange(-1.5, 1.5, 0.04))
    return np.stack([x, y, 0 * x], 1)


def corridor() -> np.ndarray:
    x, s = grid(np.arange(-4, 4, 0.06), np.arange(-1, 1, 0.06))
    one = np.ones_like(x)
    sides = [[x, s, -one], [x, s, one], [x, -one, s], [x, one, s]]
    return np.concatenate([np.stack(side, 1) for side in sides])


def cylinder() -> np.ndarray:
    z, angle = grid(np.arange(-2, 2, 0.06), np.linspace(0, 2 * np.pi, 100, endpoint=False))
    return np.stack([np.cos(angle), np.sin(angle), z], 1)


def shaken(points: np.ndarray, seed: int) -> np.ndarray:
    return points + np.random.default_rng(seed).normal(0, 0.003, points.shape)


@pytest.mark.parametrize(("shape", "said"), [
    (plane, {"shift along (1.00, 0.00, 0.00)", "shift along (0.00, 1.00, 0.00)", "rotation about (0.00, 0.00, 1.00)"}),
    (corridor, {"shift along (1.00, 0.00, 0.00)"}),
    (cylinder, {"shift along (0.00, 0.00, 1.00)", "rotation about (0.00, 0.00, 1.00)"}),
])  # fmt: skip
def test_what_a_shape_does_not_determine_is_named(shape, said: set[str]) -> None:
    points = shape()
    source, target = (Surface(shaken(points, seed), 0.1) for seed in (0, 1))
    weak = observability.in_words(left_open(source, target))
    assert len(weak) == len(said)
    kinds = sorted(w.split(" (")[0] for w in weak)
    assert kinds == sorted(s.split(" (")[0] for s in said)
    if shape is not plane:  # whose two shifts may be named by any two directions in it
        assert {w.replace("-0.01", "0.00").replace("0.01", "0.00") for w in weak} == said


def test_a_room_determines_everything(room_scans: Scans) -> None:
    source, target = (Surface(s, EDGE) for s in room_scans)
    info = observability.certainty(source, target, np.eye(4), np.zeros(3)).information
    assert info.shape == (6, 6)
    np.testing.assert_allclose(info, info.T, rtol=1e-9, atol=1e-9 * np.abs(info).max())
    assert np.linalg.eigvalsh(info).min() > 0
    assert observability.weak_twists(info, target.points - target.points.mean(0)).shape == (6, 0)


def test_along_a_street_a_roll_is_determined_as_far_as_it_moves_anything() -> None:
    """60 m of road and low walls beside it: a roll moves no point by more than its few metres from the middle."""
    rng = np.random.default_rng(2)
    road = np.column_stack([rng.uniform(-30, 30, 9000), rng.uniform(-2, 2, 9000), np.zeros(9000)])
    walls = np.column_stack([rng.uniform(-30, 30, 9000), rng.choice([-2.0, 2.0], 9000), rng.uniform(0, 1, 9000)])
    ends = np.column_stack([rng.choice([-30.0, 30.0], 3000), rng.uniform(-2, 2, 3000), rng.uniform(0, 1, 3000)])
    street = np.vstack([road, walls, ends])
    source, target = (Surface(street + rng.normal(0, 0.01, street.shape), 0.3) for _ in "ab")
    info = observability.certainty(source, target, np.eye(4), np.zeros(3)).information
    centre = target.points.mean(0)
    assert observability.weak_twists(observability.about(info, centre), target.points - centre).shape == (6, 0)


def left_open(source: Surface, target: Surface) -> np.ndarray:
    """The twists (6, k) that two scans of one frame do not determine: what ``align`` names."""
    centre = target.points.mean(0)
    info = observability.certainty(source, target, np.eye(4), np.zeros(3)).information
    weak = observability.weak_twists(observability.about(info, centre), target.points - centre)
    return observability.unopposed(weak, source, target, np.eye(4), centre)


def ball(rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(2000, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def pipe(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi, 2000)
    return np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(-5, 5, 2000)])


def passage(rng: np.random.Generator) -> np.ndarray:
    """Two walls, floor and ceiling, 20 m long."""
    points = rng.uniform([-10, -1, 0], [10, 1, 2.6], (2000, 3))
    across = np.arange(2000) % 4
    points[across < 2, 1] = np.where(across[across < 2] == 0, -1.0, 1.0)
    points[across >= 2, 2] = np.where(across[across >= 2] == 2, 0.0, 2.6)
    return points


@pytest.mark.parametrize(("shape", "said"), [(ball, "rotation"), (pipe, "shift along"), (passage, "shift along")])
def test_few_points_that_fall_differently_determine_no_more(shape, said: str) -> None:
    """Two samples of one shape: their normals' errors pretend to know what the shape leaves open."""
    source, target = (
        Surface(points, working_scale(points, np.random.default_rng(0))[0])
        for points in (shape(np.random.default_rng(seed)) for seed in (0, 1))
    )
    assert any(w.startswith(said) for w in observability.in_words(left_open(source, target)))


def facade(rng: np.random.Generator, depth: float) -> np.ndarray:
    """A wall of 16 m by 5 m over its pavement, and two windows that are let into it by ``depth``."""
    wall = rng.uniform([-8, 0, 0], [8, 0, 5], (9000, 3))
    floor = rng.uniform([-8, -3, 0], [8, 0, 0], (5000, 3))
    sides = []
    for left in (-4.0, 3.0):
        window = (np.abs(wall[:, 0] - left - 0.6) < 0.6) & (np.abs(wall[:, 2] - 2) < 0.7)
        wall[window, 1] += depth
        sides += [rng.uniform([x, 0, 1.3], [x, depth, 2.7], (int(160 * depth), 3)) for x in (left, left + 1.2)]
    return np.vstack([wall, floor, *sides])


@pytest.mark.parametrize(("depth", "shifts"), [(0.0, 1), (0.2, 0)])
def test_the_sides_of_a_few_windows_determine_a_facade(depth: float, shifts: int) -> None:
    """Against the wall they are hardly any information, and yet all that it takes; without them, nothing holds it."""
    source, target = (Surface(shaken(facade(np.random.default_rng(i), depth), i), 0.15) for i in (0, 1))
    centre = target.points.mean(0)
    info = observability.certainty(source, target, np.eye(4), np.zeros(3)).information
    weak = observability.weak_twists(observability.about(info, centre), target.points - centre)
    assert weak.shape[1] == 1
    assert left_open(source, target).shape[1] == shifts


def test_normals_that_noise_turns_hold_nothing() -> None:
    """A plane whose normals lean by 4 to 7 deg, each scan's another way: by themselves they would oppose all shifts."""
    noisy = [plane() + np.random.default_rng(i).normal(0, 0.02, plane().shape) for i in (0, 1)]
    source, target = (Surface(points, 0.08) for points in noisy)
    assert left_open(source, target).shape[1] == 3


def test_more_noise_is_less_information() -> None:
    points = corridor()
    still, noisy = (
        observability.certainty(Surface(points + n, 0.1), Surface(points, 0.1), np.eye(4), np.zeros(3)).information
        for n in np.random.default_rng(0).normal(0, 1, (2, 1, *points.shape)).reshape(2, -1, 3) * [[[0.002]], [[0.02]]]
    )
    assert still[2, 2] > 10 * noisy[2, 2]


def test_the_covariance_is_that_of_the_error() -> None:
    """Over many draws of one room's noise: the squared error in its own deviations, 5.35 expected."""
    rng = np.random.default_rng(5)
    box = rng.uniform(-1, 1, (9000, 3))
    box[np.arange(9000), rng.integers(0, 3, 9000)] = rng.choice([-1.0, 1.0], 9000)
    box = box * [2, 1.5, 1]
    squared = []
    for _ in range(20):
        source, target = (
            Surface(box[rng.permutation(9000)[:6000]] + rng.normal(0, 0.01, (6000, 3)), 0.1) for _ in "ab"
        )
        T = np.eye(4)
        for _ in range(4):
            found = point_to_plane(
                source.points, target.points, target.normals, target.tree, T, 0.15, np.zeros(3)
            )  # fmt: skip
            T = step_motion(-np.linalg.solve(found.A[:6, :6], found.b[:6])) @ T
        twist = log(T)
        covariance = observability.certainty(source, target, T, np.zeros(3)).covariance
        squared.append(twist @ np.linalg.solve(covariance, twist))
    assert 2 < np.median(squared) < 12  # within 1.6 times the true deviations


def test_a_range_bias_counts_along_the_view_where_the_eye_is_known() -> None:
    """A corner seen from afar: a longer range moves it along the view, and nothing in the residuals tells."""
    rng = np.random.default_rng(3)
    box = rng.uniform(0, 1, (9000, 3))
    box[np.arange(9000), rng.integers(0, 3, 9000)] = 0.0
    eye, sigma = np.array([20.0, 20.0, 20.0]), 0.005
    source, target = (
        Surface(box[half] + rng.normal(0, 0.001, (4500, 3)), 0.05) for half in np.split(np.arange(9000), 2)
    )
    view = np.concatenate([np.zeros(3), eye / np.linalg.norm(eye)])

    def along(eyes: tuple[np.ndarray | None, ...], noise: float) -> float:
        found = observability.certainty(source, target, np.eye(4), source.points.mean(0), (noise, noise), eyes)
        return float(np.sqrt(view @ found.covariance @ view))

    both = 2**0.5 * sigma  # the bias of either scan
    assert along((eye, eye), sigma) == pytest.approx(both, rel=0.25)
    assert along((None, None), sigma) < 0.5 * both
    assert along((eye, eye), 0.0) < 0.1 * both


def test_a_turn_is_seen_about_the_scan_however_far_the_map_s_centre_is(room_scans: Scans) -> None:
    source, target = (Surface(s, EDGE) for s in room_scans)
    near = observability.certainty(source, target, np.eye(4), np.zeros(3)).information
    away = np.array([80.0, 30.0, 0.0])
    far = observability.certainty(source, target, np.eye(4), away).information
    points = target.points - target.points.mean(0)
    assert observability.weak_twists(far, points).shape[1]
    assert not observability.weak_twists(observability.about(far, -away), points).shape[1]
    np.testing.assert_allclose(observability.about(far, -away), near, rtol=1e-6, atol=1e-6 * np.abs(near).max())


def test_a_direction_that_one_block_alone_holds_is_no_division_by_nothing() -> None:
    """Eight blocks of six observations, one a direction; only the first block has one of the last direction."""
    J, block = np.tile(np.eye(6), 8), np.repeat(np.arange(8), 6)
    J[5, block > 0] = 0.0
    pull = np.random.default_rng(0).normal(size=48)
    found = observability.sandwich(J, pull, np.ones(48), block)
    assert np.isfinite(found).all()
    assert 0.3 < np.sqrt(found[0, 0] * 8) < 3  # of unit noise, seen eight times


def drawn(rng: np.random.Generator, blocks: int, each: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J (6, N), its residuals at the truth, which a block has in common, and the blocks (N,)."""
    block = np.repeat(np.arange(blocks), each)
    J = rng.normal(size=(6, blocks))[:, block] + 0.3 * rng.normal(size=(6, blocks * each))
    return J, rng.normal(size=blocks)[block] + 0.5 * rng.normal(size=blocks * each), block


def test_few_blocks_give_as_much_covariance_as_the_error_has() -> None:
    """Fifteen blocks, their residuals at the estimate; by the jackknife it would be 1.4 times as much."""
    rng = np.random.default_rng(1)
    J, _, block = drawn(rng, 15, 20)
    errors, found = [], []
    for _ in range(400):
        r = rng.normal(size=15)[block] + 0.5 * rng.normal(size=len(block))
        x = -np.linalg.solve(J @ J.T, J @ r)
        errors.append(x)
        found.append(observability.sandwich(J, r + x @ J, np.ones(len(block)), block))
    true = np.cov(np.array(errors).T)
    ratio = np.trace(np.linalg.solve(true, np.mean(found, axis=0))) / 6
    assert 0.75 < ratio < 1.25


def test_another_optimum_adds_along_the_step_to_it_alone() -> None:
    J, r, block = drawn(np.random.default_rng(2), 60, 10)
    best = r - np.linalg.lstsq(J.T, r, rcond=None)[0] @ J
    step = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0])  # of tens of deviations
    here, away = (observability.sandwich(J, pull, np.ones(len(r)), block) for pull in (best, best + step @ J))
    grown = away - here
    np.testing.assert_allclose(grown, np.outer(step, step), atol=0.03 * 4)


def test_information_says_the_same_of_a_motion_in_another_frame() -> None:
    rng = np.random.default_rng(0)
    J, in_a, T_b_a = rng.normal(size=(6, 9)), rng.normal(size=6), exp(rng.normal(size=6))
    information, in_b = J @ J.T, adjoint(T_b_a) @ in_a
    moved = observability.in_frame(information, T_b_a)
    assert np.isclose(in_b @ moved @ in_b, in_a @ information @ in_a)
