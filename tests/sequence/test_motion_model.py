"""Constant velocity: the prediction, and how its uncertainty grows where nothing is seen and shrinks where it is."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.point_to_plane import step_motion
from fmr_cli.sequence.motion_model import MotionModel, told_motion
from fmr_cli.sequence.observability import Observability

MOTION = step_motion(np.array([0.0, 0.0, 0.1, 3.0, 0.0, 0.0]))


def all_seen(sigma):
    """Every direction observed, to ``sigma`` voxels (and radians at radius 20)."""
    return Observability(
        np.zeros(3), 20.0, np.eye(6), np.ones(6), np.diag([20.0**2] * 3 + [1.0] * 3) / sigma**2
    )  # fmt: skip


def moved(model, frames, seen):
    for _ in range(frames):
        expected = model.expect()
        model.advance(model.T_map_scan @ MOTION, expected, seen)
    return model


def test_the_last_motion_again():
    model = moved(MotionModel(np.eye(4), 20.0), 3, all_seen(0.01))
    assert np.allclose(model.expect().T_map_scan, MOTION @ MOTION @ MOTION @ MOTION)


def test_unseen_the_sigma_grows_and_seen_again_it_shrinks():
    model = moved(MotionModel(np.eye(4), 20.0), 10, all_seen(0.01))
    sigmas = [model.sigma(model.T_map_scan[:3, 3])[1]]
    for _ in range(5):
        moved(model, 1, None)
        sigmas.append(model.sigma(model.T_map_scan[:3, 3])[1])
    assert sigmas[0] < 0.02
    assert np.all(np.diff(sigmas) > 0)
    assert sigmas[5] > 3 * sigmas[1]
    assert moved(model, 1, all_seen(0.01)).sigma(np.zeros(3))[1] < 0.02


def test_what_an_unseen_pose_was_off_is_not_taken_for_motion():
    """Unseen it is left where it was for two frames, and then found three motions on: it is not three times as fast."""
    model = moved(MotionModel(np.eye(4), 20.0), 10, all_seen(0.01))
    goal = model.T_map_scan @ MOTION @ MOTION @ MOTION
    for _ in range(2):
        model.advance(model.T_map_scan, model.expect(), None)
    model.advance(goal, model.expect(), all_seen(0.01))
    assert np.linalg.norm((np.linalg.inv(goal) @ model.expect().T_map_scan)[:3, 3]) < 1.5 * 3.0


def test_a_fit_counts_only_where_it_has_observed():
    model = moved(MotionModel(np.eye(4), 20.0), 10, all_seen(0.01))
    expected = model.expect()
    predicted = expected.T_map_scan
    along_y = np.zeros((6, 6))
    along_y[4, 4] = 1e6
    seen = Observability(predicted[:3, 3], 20.0, np.eye(6), np.array([0, 0, 0, 0, 1.0, 0]), along_y)
    off = step_motion(np.array([0, 0, 0, 0.5, 0.2, -0.4])) @ predicted
    held = model.combined(off, expected, seen)
    shift = held[:3, 3] - predicted[:3, 3]
    assert abs(shift[1] - 0.2) < 0.01
    assert np.abs(shift[[0, 2]]).max() < 0.05
    assert Rotation.from_matrix(held[:3, :3] @ predicted[:3, :3].T).magnitude() < 0.02


def test_after_a_gap_the_motion_has_gone_on():
    model = moved(MotionModel(np.eye(4), 20.0), 3, all_seen(0.01))
    there = np.linalg.matrix_power(MOTION, 5)
    assert np.allclose(model.expect(pace=2.0).T_map_scan, there)
    assert np.allclose(model.expect(pace=np.nan).T_map_scan, model.expect().T_map_scan)


def test_a_told_motion_is_followed_as_far_as_it_is_sure():
    faster = step_motion(np.array([0.0, 0.0, 0.1, 4.0, 0.0, 0.0]))
    model = moved(MotionModel(np.eye(4), 20.0), 15, all_seen(0.01))
    sigmas = []
    for sigma, closer in ((1e-3, faster), (100.0, MOTION)):
        expected = model.expect(told_motion(faster, 0.1 * sigma, sigma, np.zeros(3)))
        step = np.linalg.inv(model.T_map_scan) @ expected.T_map_scan
        assert np.abs(step - closer).max() < 0.15
        sigmas.append(expected.covariance[3, 3])
    assert sigmas[0] < sigmas[1]


def test_along_what_nobody_sees_told_motions_add_up():
    """2 % off over 40 frames of 3 voxels, and the noise of 0.2 in each told position does not add up."""
    rng, model = np.random.default_rng(0), MotionModel(np.eye(4), 20.0)
    straight = step_motion(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]))
    for _ in range(10):
        model.advance(model.T_map_scan @ straight, model.expect(), all_seen(0.01))
    begin = model.T_map_scan[0, 3]
    for noise in np.diff(rng.normal(0, 0.2, 41)):
        told = step_motion(np.array([0.0, 0, 0, 3.0 * 1.02 + noise, 0, 0]))
        expected = model.expect(told_motion(told, 0.01, 0.3, np.zeros(3)))
        model.advance(expected.T_map_scan, expected, None)
    assert abs(model.T_map_scan[0, 3] - begin - 40 * 3.0) < 0.02 * 40 * 3.0 + 0.4
    assert np.abs(model.T_map_scan[1:3, 3]).max() < 0.4
