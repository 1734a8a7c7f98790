"""The last step suits what the scans are: two noisy ones are smoothed, a clean one keeps its own planes."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli import PointCloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.geometry.gicp import GicpCloud
from fmr_cli.geometry.observability import certainty
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.se3 import log
from fmr_cli.registration import Options, prepare, refinement
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.near_pairs import Degraded, near_pair, two_sensors
from fmr_cli.synthetic.shapes import shapes


def pair_of(number: int, swapped: bool) -> tuple[Pair, np.ndarray, np.ndarray]:
    """A noisy depth camera onto a clean laser scanner, or the other way about; the true pose and one near it."""
    near = near_pair(two_sensors(np.random.default_rng(number), 6000), Degraded(0.01, 0.0), np.random.default_rng(9))
    clouds, true, start = (near.source, near.target), near.T_target_source, near.start
    if swapped:
        clouds, true, start = clouds[::-1], np.linalg.inv(true), np.linalg.inv(start)
    pair = make_pair(*(prepare(PointCloud(points)) for points in clouds), Options())
    return pair, pair.enter_centred(true), refinement.by_planes(pair, pair.enter_centred(start))


@pytest.mark.parametrize("swapped", [False, True], ids=["noisy source", "noisy target"])
def test_between_a_noisy_and_a_clean_scan_the_planes_of_the_clean_one_count(swapped: bool) -> None:
    off = []
    for number in range(5):
        pair, true, start = pair_of(number, swapped)
        assert refinement.noisy(pair)
        s, t = pair.source.fine(refinement.GICP_SOURCE, pair.edge), pair.target.fine(refinement.GICP_TARGET, pair.edge)
        found = refinement.by_geometry(pair, start).T_target_source, refinement.by_smoothed(pair, start, s, t)
        off.append([angle_degrees(np.linalg.inv(true) @ T) for T in found])
    ours, smoothed = np.median(off, axis=0)
    assert ours < 0.85 * smoothed


def squared_error(pair: Pair, true: np.ndarray) -> float:
    """Of the polished pose, in its own deviations: 5.35 is the median of six."""
    polished = refinement.exact(pair, refinement.by_geometry(pair, refinement.by_planes(pair, true)))
    T = polished.T_target_source
    covariance = certainty(pair.s, pair.t, T, np.zeros(3), polish=polished.observed()).covariance
    twist = log(T @ np.linalg.inv(true))
    return float(twist @ np.linalg.solve(covariance, twist))


def pebble(rng: np.random.Generator) -> np.ndarray:
    """4,000 points of a smooth body that is bent everywhere."""
    points = rng.normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return points * [1, 0.7, 0.5] * (1 + 0.15 * np.sin(4 * points[:, :1]) * np.cos(3 * points[:, 1:2]))


def test_the_covariance_is_that_of_the_points_that_the_pose_was_polished_on() -> None:
    """Two clean samples of a body, a dozen times: voxels, on which bends look like noise, say twice as much."""
    squared = []
    for number in range(12):
        rng = np.random.default_rng(number)
        pair = make_pair(*(prepare(PointCloud(pebble(rng))) for _ in "ab"), Options())
        squared.append(squared_error(pair, pair.enter_centred(np.eye(4))))
    assert 3.5 < np.median(squared) < 9


def test_the_pose_of_copies_has_a_covariance_of_six_directions() -> None:
    """Without any misfit, hardly any, but for what rounding leaves open."""
    (points,) = shapes(1, 3000, 4)
    pair = make_pair(*(prepare(PointCloud(points)) for _ in "ab"), Options())
    polished = refinement.by_geometry(pair, np.eye(4))
    covariance = certainty(pair.s, pair.t, polished.T_target_source, np.zeros(3), polish=polished.observed()).covariance
    deviations = np.sqrt(np.linalg.eigvalsh(covariance))
    assert deviations.min() > 1e-8 * pair.edge
    assert deviations.max() < 1e-4 * pair.edge


def test_other_steps_than_gicp_leave_the_covariance_to_the_voxels() -> None:
    pair, _, start = pair_of(0, swapped=False)
    assert refinement.by_geometry(pair, start).observed() is None
    held = make_pair(pair.source, pair.target, Options(dof="yaw"))
    assert refinement.by_geometry(held, start).observed() is None


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    """Views of a room by a depth camera, metres."""
    rng = np.random.default_rng(900)
    room = scenes.room(rng)
    views = [scenes.room_scan(room, rng, np.array([0.1 * k, 0.0, 1.4]), 0.7 * k) for k in range(9)]
    return rng.permutation(np.concatenate(views))


def test_strips_of_fine_voxels_are_as_exact_as_all_of_them(room: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "LARGE", 50_000)
    off = []
    for number in range(5):
        halves = np.random.default_rng(number).permutation(room)[:200_000].reshape(2, -1, 3)
        pair = make_pair(*(prepare(PointCloud(points)) for points in halves), Options())
        true = pair.enter_centred(np.eye(4))
        fine = refinement.finer_edge(pair)
        assert fine is not None
        strips = refinement.by_geometry(pair, refinement.by_planes(pair, true)).T_target_source
        s, t = (GicpCloud(cloud.thinned(fine), fine) for cloud in (pair.source, pair.target))
        everywhere = refinement.by_gicp(s, t, strips, fine).T_target_source
        off.append([pose_error(T, true)[1] for T in (strips, everywhere)])
    ours, plain = np.median(off, axis=0)
    assert ours < 2 * plain  # of a quarter of the points or less
    assert ours < 0.02 * pair.edge


def test_copies_that_gicp_leaves_apart_come_to_coincide(room: np.ndarray) -> None:
    points = room[:60_000]
    pair = make_pair(*(prepare(PointCloud(points)) for _ in "ab"), Options())
    near = refinement.by_geometry(pair, refinement.by_planes(pair, np.eye(4)))
    polished = refinement.exact(pair, near)
    assert np.abs(near.T_target_source - np.eye(4)).max() > 1e-8
    assert np.abs(polished.T_target_source - np.eye(4)).max() < 1e-12
    covariance = certainty(pair.s, pair.t, polished.T_target_source, np.zeros(3), polish=polished.observed()).covariance
    assert 0 < np.linalg.eigvalsh(covariance).min() <= np.linalg.eigvalsh(covariance).max() < (1e-4 * pair.edge) ** 2
