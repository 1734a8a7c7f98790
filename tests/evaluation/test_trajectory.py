"""Errors of a trajectory: KITTI's by hand and against another implementation; the rest by what is plainly known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.evaluation.trajectory import KITTI_LENGTHS, KITTI_STEP, evaluate, segment_errors, summary


def straight(frames: int, each: float = 1.0) -> np.ndarray:
    """Poses (n, 4, 4) along x, ``each`` apart, heading along x."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = each * np.arange(frames)
    return poses


def wandering(frames: int, seed: int, step: float = 1.1) -> np.ndarray:
    """A path that turns and climbs at random."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for turn, length in zip(rng.normal(0, 0.02, (frames - 1, 3)), rng.uniform(0, 2 * step, frames - 1), strict=True):
        move = np.eye(4)
        move[:3, :3], move[0, 3] = Rotation.from_rotvec(turn).as_matrix(), length
        poses.append(poses[-1] @ move)
    return np.array(poses)


def drifting(truth: np.ndarray, seed: int) -> np.ndarray:
    """The truth with a small error in every motion."""
    rng = np.random.default_rng(seed)
    poses = [truth[0]]
    for a, b in itertools.pairwise(truth):
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix()
        error[:3, 3] = rng.normal(0, 0.01, 3)
        poses.append(poses[-1] @ np.linalg.inv(a) @ b @ error)
    return np.array(poses)


def test_kitti_s_segments_worked_out_by_hand():
    # 1 m a frame, 1 % too long: a segment of 100 ends at the first frame that is further, 101 frames on, where the
    # error is 1.01 m, 1.01 % of 100. From frames 0, 10, ..., 190 of 300: of 100 there are 20, of 200 10 (to frame 90).
    found = segment_errors(straight(300, 1.01), straight(300), KITTI_LENGTHS, KITTI_STEP)
    assert np.bincount(found.length.astype(int))[[100, 200]].tolist() == [20, 10]
    assert found.translation[found.length == 100] == pytest.approx(0.0101)
    assert found.translation[found.length == 200] == pytest.approx(0.01005)
    assert found.means()[0] == pytest.approx((20 * 1.01 + 10 * 1.005) / 30)  # over segments, not over lengths
    assert found.means()[1] == pytest.approx(0, abs=1e-9)


def test_kitti_s_rotation_worked_out_by_hand():
    # Turns by 0.01 deg a frame: after 101 frames 1.01 deg, over 100 m.
    turning = straight(150)
    turning[:, :3, :3] = Rotation.from_rotvec(np.radians(0.01) * np.arange(150)[:, None] * [0, 0, 1]).as_matrix()
    found = segment_errors(turning, straight(150), KITTI_LENGTHS, KITTI_STEP)
    assert len(found.length) == 5  # from frames 0, 10, 20, 30, 40
    assert found.means()[1] == pytest.approx(1.01)


def test_a_segment_needs_a_frame_that_is_further_than_its_length():
    assert len(segment_errors(straight(101), straight(101), KITTI_LENGTHS, KITTI_STEP).length) == 0
    assert len(segment_errors(straight(102), straight(102), KITTI_LENGTHS, KITTI_STEP).length) == 1


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_kitti_s_errors_are_those_of_another_implementation(seed):
    metrics = pytest.importorskip("kiss_icp.metrics")
    truth = wandering(1200, seed)
    poses = drifting(truth, seed + 10)
    ours = segment_errors(poses, truth, KITTI_LENGTHS, KITTI_STEP).means()
    translation, rotation = metrics.sequence_error(truth, poses)  # %, deg per m, by 180 / 3.14
    assert len(segment_errors(poses, truth, KITTI_LENGTHS, KITTI_STEP).length) > 300
    assert ours == pytest.approx((translation, 100 * rotation * 3.14 / np.pi), rel=1e-5)


def test_what_is_said_of_a_long_path_and_of_a_short_one():
    pytest.importorskip("evo")
    long = evaluate(straight(300, 1.01), straight(300))
    assert long["kitti"]
    assert [(s["length"], s["count"]) for s in long["segments"]] == [(100, 20), (200, 10)]
    assert long["end_drift_percent"] == pytest.approx(1)
    assert summary(long)[0].startswith("KITTI segments of 100 to 200: 1.008 %")
    short = evaluate(straight(41, 1.01), straight(41))
    assert not short["kitti"]
    assert [s["length"] for s in short["segments"]] == pytest.approx([4 * tenths for tenths in range(1, 9)])
    assert summary(short)[0].startswith("segments of 4 to 32: ")


def test_ape_is_aligned_at_the_first_pose_alone():
    pytest.importorskip("evo")
    truth = straight(50)
    other_frame = np.eye(4)
    other_frame[:3, :3], other_frame[:3, 3] = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix(), [5, 6, 7]
    assert evaluate(other_frame @ truth, truth)["ape_rmse_first_pose"] == pytest.approx(0, abs=1e-9)
    bent = truth.copy()
    bent[0, :3, :3] = Rotation.from_rotvec([0, 0, np.radians(1)]).as_matrix()  # the first heading alone is wrong
    off = 2 * np.sin(np.radians(0.5)) * np.sqrt(np.mean(np.arange(50.0) ** 2))
    assert evaluate(bent, truth)["ape_rmse_first_pose"] == pytest.approx(off)


def test_no_motion_has_no_segments():
    pytest.importorskip("evo")
    still = np.tile(np.eye(4), (20, 1, 1))
    moved = still.copy()
    moved[-1, 0, 3] = 1.0
    errors = evaluate(still, moved)
    assert errors["end_drift_percent"] == pytest.approx(100)
    assert errors["translation_percent"] is not None


def test_a_truth_that_stands_still_has_no_drift_in_percent():
    pytest.importorskip("evo")
    still = np.tile(np.eye(4), (20, 1, 1))
    errors = evaluate(still, still)
    assert errors["end_drift_percent"] is None
    assert errors["segments"] == []
    assert summary(errors) == ["APE from the first pose 0, RPE 0 and 0 deg a frame"]
