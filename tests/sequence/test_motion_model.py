"""Constant velocity: the prediction, and how its uncertainty grows where nothing is seen and shrinks where it is."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.point_to_plane import step_motion
from fmr_cli.sequence.motion_model import MotionModel
from fmr_cli.sequence.observability import Observability

MOTION = step_motion(np.array([0.0, 0.0, 0.1, 3.0, 0.0, 0.0]))


def all_seen(sigma):
    """Every direction observed, to ``sigma`` voxels (and radians at radius 20)."""
    return Observability(
        np.zeros(3), 20.0, np.eye(6), np.ones(6), np.diag([20.0**2] * 3 + [1.0] * 3) / sigma**2
    )  # fmt: skip


def moved(model, frames, seen):
    for _ in range(frames):
        predicted = model.predict()
        model.advance(model.T_map_last[-1] @ MOTION, predicted, seen)
    return model


def test_the_last_motion_again():
    model = moved(MotionModel(np.eye(4), 20.0), 3, all_seen(0.01))
    assert np.allclose(model.predict(), MOTION @ MOTION @ MOTION @ MOTION)


def test_unseen_the_sigma_grows_and_seen_again_it_shrinks():
    model = moved(MotionModel(np.eye(4), 20.0), 10, all_seen(0.01))
    sigmas = [model.sigma(model.T_map_last[-1][:3, 3])[1]]
    for _ in range(5):
        moved(model, 1, None)
        sigmas.append(model.sigma(model.T_map_last[-1][:3, 3])[1])
    assert sigmas[0] < 0.02
    assert np.all(np.diff(sigmas) > 0)
    assert sigmas[5] > 3 * sigmas[1]
    assert moved(model, 1, all_seen(0.01)).sigma(np.zeros(3))[1] < 0.02


def test_a_fit_counts_only_where_it_has_observed():
    model = moved(MotionModel(np.eye(4), 20.0), 10, all_seen(0.01))
    predicted = model.predict()
    along_y = np.zeros((6, 6))
    along_y[4, 4] = 1e6
    seen = Observability(predicted[:3, 3], 20.0, np.eye(6), np.array([0, 0, 0, 0, 1.0, 0]), along_y)
    off = step_motion(np.array([0, 0, 0, 0.5, 0.2, -0.4])) @ predicted
    held = model.combined(off, predicted, seen)
    shift = held[:3, 3] - predicted[:3, 3]
    assert abs(shift[1] - 0.2) < 0.01
    assert np.abs(shift[[0, 2]]).max() < 0.05
    assert Rotation.from_matrix(held[:3, :3] @ predicted[:3, :3].T).magnitude() < 0.02
