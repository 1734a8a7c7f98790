"""The picture of a sequence: what it shows of which run, and that short, long and doubtful ones are drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud
from fmr_cli.evaluation.truth import Truth
from fmr_cli.geometry.se3 import exp
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.result import SequenceResult
from fmr_cli.sequence.scans import Scans

pytest.importorskip("matplotlib")
from fmr_cli.report.sequence_picture import about_path, stretches, to_draw, write_picture

T_CAMERA_SCAN = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])


def loop(frames: int) -> np.ndarray:
    """Poses (n, 4, 4) around a circle, one length apart, going up and down."""
    turn = 2 * np.pi * np.arange(frames) / max(frames, 2)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turn[:, None] * [0, 0, 1]).as_matrix()
    radius = frames / (2 * np.pi)
    poses[:, :3, 3] = np.stack([radius * np.sin(turn), radius * (1 - np.cos(turn)), np.sin(2 * turn)], 1)
    return poses


def made(frames: int, uncertain: tuple[int, ...] = (), closed: tuple[tuple[int, int], ...] = ()):
    """A result and its scans; of the uncertain frames every other one has sigmas, of the rest some have None."""
    poses = loop(frames)
    rows = [{"frame": n, "file": f"{n}.ply", "status": "aligned", "motion": 1.0} for n in range(frames)]
    for n, frame in enumerate(uncertain):
        rows[frame]["status"] = "uncertain"
        if n % 2 == 0:
            rows[frame] |= {"unobserved": "x", "sigma_shift": 2.0, "sigma_rotation_deg": 0.5}
    for row in rows[::7]:
        row.setdefault("sigma_shift", None)
    cloud = PointCloud(np.random.default_rng(0).normal(0, [20, 20, 2], (500, 3)))
    before = poses @ exp(np.array([0, 0, 0, 0.1, 0, 0])) if closed else None
    return SequenceResult(poses, rows, 0.2, before, len(closed), None, closed), Scans(
        [cloud] * frames, range(frames), frames
    )


def picture_text(tmp_path, *of, truth: Truth | None = None) -> str:
    """The words of the picture, as SVG has them."""
    write_picture(tmp_path / "p.svg", *of, SequenceOptions(), truth)
    return (tmp_path / "p.svg").read_text("utf-8")


def test_with_truth_loops_and_uncertain_frames(tmp_path):
    result, scans = made(150, (40, 41, 42), ((0, 149),))
    text = picture_text(tmp_path, result, scans, truth=Truth(result.poses, np.arange(150.0)))
    for said in (">truth<", "uncertain frames (3)", "loops (1)", ">before loops<", ">height<", ">sigma, shift<",
                 ">aligned<", "KITTI's error by length: translation, %", "rotation, deg / 100"):  # fmt: skip
        assert said in text, said
    assert "no frame has one" not in text


def test_without_truth_its_panels_are_absent_and_what_is_not_there_is_not_named(tmp_path):
    text = picture_text(tmp_path, *made(150))
    for said in (">truth<", "error by length", "uncertain frames", "loops"):
        assert said not in text, said
    assert text.count("every direction is observed") == 2


@pytest.mark.parametrize(("frames", "uncertain"), [(1, ()), (2, (1,)), (5_000, tuple(range(5_000)))])
def test_short_and_long_ones_with_and_without_truth(tmp_path, frames, uncertain):
    result, scans = made(frames, uncertain)
    truth = Truth(result.poses, np.arange(frames, dtype=float)) if frames > 1 else None
    for suffix, begin in ((".png", b"\x89PNG"), (".pdf", b"%PDF")):
        write_picture(tmp_path / f"p{suffix}", result, scans, SequenceOptions(), truth if suffix == ".png" else None)
        assert (tmp_path / f"p{suffix}").read_bytes().startswith(begin)


def test_uncertain_frames_without_sigmas_are_not_said_to_be_observed(tmp_path):
    result, scans = made(20, (3,))
    rows = [{name: value for name, value in row.items() if "sigma" not in name} for row in result.rows]
    text = picture_text(tmp_path, replace(result, rows=rows), scans)
    assert text.count("no frame has one") == 2
    assert "every direction is observed" not in text


def test_the_truth_lies_on_a_path_that_is_right_in_whatever_frame_both_are_given():
    """True poses in another world, half of them, of the camera: drawn, they are the path of the scanner."""
    result, scans = made(60)
    camera = replace(result, poses=T_CAMERA_SCAN @ result.poses @ np.linalg.inv(T_CAMERA_SCAN))
    some = np.arange(10, 60, 2)
    truth = Truth(exp(np.array([0.3, 0.2, 0.1, 5, 6, 7])) @ camera.poses[some], some.astype(float))
    drawn = to_draw(
        camera, replace(scans, T_camera_scan=T_CAMERA_SCAN), SequenceOptions(camera_frame=True), truth
    )  # fmt: skip
    np.testing.assert_allclose(drawn.path, result.poses, atol=1e-9)
    np.testing.assert_allclose(drawn.true, result.poses[some], atol=1e-9)


def test_stretches_of_one_status():
    assert stretches(np.array([True, True, False, True])) == [(0, 2), (3, 4)]
    assert stretches(np.array([False])) == []


def test_a_short_path_is_no_dot_in_its_map():
    seen = np.random.default_rng(0).uniform(-100, 100, (1000, 2))
    low, high = about_path(seen, np.array([[0.0, 0.0], [4.0, 0.0]]))
    assert (high - low < 120).all()  # the path and a quarter of the map on each side
    assert (low < 0).all()
    assert (high > [4, 0]).all()
    low, high = about_path(seen, np.array([[-90.0, 0.0], [90.0, 0.0]]))
    assert (low > -110).all()  # never more than the map
    assert (high < 110).all()
