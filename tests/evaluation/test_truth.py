"""True poses of files, and which frame each belongs to: by rows, or by times of their own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import angle_degrees
from fmr_cli.errors import FmrError
from fmr_cli.evaluation.trajectory import evaluate
from fmr_cli.evaluation.truth import Truth, read_truth
from fmr_cli.geometry.se3 import exp
from fmr_cli.io import write_poses

pytest.importorskip("evo")
pytest.importorskip("matplotlib")


def bend(at: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) at seconds (n,): 10 m/s around a circle of 25 m, heading along it."""
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(0.4 * at[:, None] * [0, 0, 1]).as_matrix()
    poses[:, :3, 3] = 25 * np.stack([np.sin(0.4 * at), 1 - np.cos(0.4 * at), 0 * at], 1)
    return poses


def write_tum(path, stamps, poses):
    rows = np.column_stack([stamps, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    np.savetxt(path, rows, header="timestamp tx ty tz qx qy qz qw")


def off(truth: Truth, times: np.ndarray) -> tuple[float, float]:
    """How far a path that is right at the frames' times (n,) is said to be off at most, metres and degrees."""
    own = truth.beside(bend(times))
    degrees = max(angle_degrees(np.linalg.inv(a) @ b) for a, b in zip(truth.poses, own, strict=True))
    return float(np.linalg.norm((truth.poses - own)[:, :3, 3], axis=1).max()), degrees


def test_kitti_and_arrays_have_a_row_a_scan_or_one_a_chosen_scan(tmp_path):
    truth = np.stack([exp(np.array([0, 0, 0.1 * i, 1.0 * i, 0, 0])) for i in range(5)])
    write_poses(tmp_path / "kitti.txt", truth)
    np.save(tmp_path / "truth.npy", truth)
    np.save(tmp_path / "three.npy", truth[:, :3])
    np.save(tmp_path / "rows.npy", truth[:, :3].reshape(-1, 12))
    for name in ("kitti.txt", "truth.npy", "three.npy", "rows.npy"):
        of_all = read_truth(tmp_path / name, range(1, 5, 2), 5)
        np.testing.assert_allclose(of_all.poses, truth[1:5:2], atol=1e-12)
        assert of_all.frames.tolist() == [0, 1]
        np.testing.assert_allclose(read_truth(tmp_path / name, range(0, 10, 2), 10).poses, truth, atol=1e-12)
        assert of_all.note == ""


def test_few_digits_are_enough(tmp_path):
    """Three of a rotation's digits: evo takes nothing for a rotation that is not one to six."""
    truth = bend(np.arange(5.0))
    np.savetxt(tmp_path / "kitti.txt", truth[:, :3].reshape(-1, 12), fmt="%.3f")
    found = read_truth(tmp_path / "kitti.txt", range(5), 5).poses
    np.testing.assert_allclose(found, truth, atol=1e-3)
    assert evaluate(truth, found)["ape_rmse_first_pose"] < 0.1


def test_tum_without_times_of_the_scans_has_a_row_a_scan(tmp_path):
    truth = bend(np.arange(5.0))
    write_tum(tmp_path / "tum.txt", 100 + np.arange(5), truth)
    np.testing.assert_allclose(read_truth(tmp_path / "tum.txt", range(5), 5).poses, truth, atol=1e-12)
    with pytest.raises(FmrError, match="5 poses for 4 scans, and the scans have no times to match by"):
        read_truth(tmp_path / "tum.txt", range(4), 4)


@pytest.mark.parametrize("unit", [1, 1_000, 1_000_000_000])
def test_tum_of_another_rate_is_matched_by_time(tmp_path, unit):
    """100 Hz against frames at 10 Hz that begin between two of its poses; in seconds, and in ms and ns since 1970."""
    start = 0 if unit == 1 else 1_600_000_000
    seconds, rows = 0.1234 + 0.1 * np.arange(20), 0.01 * np.arange(300)
    write_tum(tmp_path / "tum.txt", (start + rows) * unit, bend(rows))
    found = read_truth(tmp_path / "tum.txt", range(20), 20, start + seconds)
    assert found.frames.tolist() == list(range(20))
    assert found.note == ""
    shift, degrees = off(found, seconds)
    assert shift < 0.001
    assert degrees < 0.001


def test_frames_outside_the_truth_and_in_its_gaps_are_not_compared(tmp_path):
    times = 0.1 * np.arange(100)
    stamps = np.concatenate([np.arange(2.0, 4.001, 0.05), np.arange(7.0, 9.001, 0.05)])
    write_tum(tmp_path / "tum.txt", stamps, bend(stamps))
    found = read_truth(tmp_path / "tum.txt", range(100), 100, times)
    assert found.frames.tolist() == [*range(20, 41), *range(70, 91)]
    assert found.note.endswith("42 of 100 frames have a true pose at their time, the others are not compared")
    assert off(found, times)[0] < 0.01


@pytest.mark.parametrize("backwards", [False, True])
def test_fewer_true_poses_than_frames_are_compared_at_their_own_times(tmp_path, backwards):
    """1 Hz in a bend: the chord between two true poses is half a metre off the way, the path's own poses are not."""
    times, stamps = 0.1 * np.arange(100), 0.04 + np.arange(-2.0, 15)
    write_tum(tmp_path / "tum.txt", stamps, bend(stamps))
    if backwards:
        times = times[::-1]
    found = read_truth(tmp_path / "tum.txt", range(100), 100, times)
    assert len(found.frames) == 10  # 0.04 to 9.04 s: the first frame is at 0, the last at 9.9
    assert (np.diff(found.frames) > 0).all()
    assert "10 true poses among 100 frames" in found.note
    shift, degrees = off(found, times)
    assert shift < 0.01
    assert degrees < 0.01


def test_a_truth_of_another_time_is_one_line(tmp_path):
    stamps = np.arange(5.0)
    write_tum(tmp_path / "tum.txt", stamps, bend(stamps))
    with pytest.raises(FmrError, match="run from 0 to 4, the scans' from 100 to 109; fewer than two") as said:
        read_truth(tmp_path / "tum.txt", range(10), 10, 100 + np.arange(10.0))
    assert "\n" not in str(said.value)
    write_tum(tmp_path / "one.txt", stamps[:1], bend(stamps[:1]))
    with pytest.raises(FmrError, match="fewer than two"):
        read_truth(tmp_path / "one.txt", range(5), 5, stamps)


NOT_FINITE = np.tile(np.eye(4), (3, 1, 1))
NOT_FINITE[1, 0, 3] = np.nan


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("bad.npy", np.zeros((3, 5)), "is no array of poses"),
        ("empty.npy", np.zeros((0, 4, 4)), "is no array of poses"),
        ("one.npy", np.array(3.0), "is no array of poses"),
        ("words.npy", np.array(["a", "b", "c"]), "is no array of poses"),
        ("no_array.npy", "0 1 2", "is no array of poses"),
        ("nan.npy", NOT_FINITE, "not finite"),
        ("zeros.npy", np.zeros((3, 4, 4)), "its last row is not 0 0 0 1"),
        ("seven.txt", "1 2 3 4 5 6 7\n" * 3, "has 7 numbers a line; KITTI has 12, TUM 8"),
        ("mixed.txt", "0 " * 8 + "\n" + "1 " * 12, "has 8 and 12 numbers a line; KITTI has 12, TUM 8"),
        ("turned.txt", "0 0 0 0 0 0 0 0\n", "its quaternions not be 0"),
        ("to_and_fro.txt", "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "its times must grow"),
        ("words.csv", "time,x,y\n1,2,3\n", "line 1: expected numbers"),
        ("empty.txt", "# nothing\n", "holds no poses"),
        ("sheared.txt", "2 0 0 0  0 1 0 0  0 0 1 0\n", "is no rotation"),
        ("missing.txt", None, "missing.txt"),
    ],
)
def test_what_is_no_truth_is_one_line_that_names_the_file(tmp_path, name, content, says):
    if isinstance(content, str):
        (tmp_path / name).write_text(content)
    elif content is not None:
        np.save(tmp_path / name, content)
    with pytest.raises(FmrError) as said:
        read_truth(tmp_path / name, range(3), 3)
    assert says in str(said.value)
    assert str(tmp_path / name) in str(said.value)
    assert "\n" not in str(said.value)
