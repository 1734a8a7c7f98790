"""What scan and map leave open is said, and follows the motion before it; what they determine is not called open."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from degenerate import block, camera, placed, seen, spinning, tunnel, wall

from fmr_cli import PointCloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.io import read_poses
from fmr_cli.sequence import align_sequence
from fmr_cli.sequence.observability import WRONG, Matches, in_words, observe
from fmr_cli.synthetic.drives import Drive, Way, depth_camera, passages


def drive(things, poses, rays, noise, reach):
    """A sequence's result and the truth, each frame to the first."""
    rng, poses = np.random.default_rng(0), np.array(poses)
    scans = [PointCloud(seen(things, T, rays, rng, noise, reach)) for T in poses]
    return align_sequence(scans), np.linalg.inv(poses[0]) @ poses


def errors(found, truth):
    """Metres and degrees of each frame's pose."""
    apart = np.linalg.inv(truth) @ found.poses
    return np.linalg.norm(apart[:, :3, 3], axis=1), np.array([angle_degrees(T) for T in apart])


def certain(found):
    return np.array([row["status"] == "aligned" for row in found.rows])


@pytest.mark.parametrize(
    ("things", "noise"),
    [
        ([tunnel(4.0)], 0.02),
        pytest.param([tunnel(4.0)], 0.003, marks=pytest.mark.slow),
        ([wall(1, 1.2), wall(1, -1.2), wall(2, -1.2), wall(2, 1.4)], 0.01),
    ],
    ids=["tunnel", "tunnel, a clean scanner", "corridor"],
)
def test_along_a_smooth_tube_no_frame_is_called_certain(things, noise):
    found, _ = drive(things, [placed(0.5 * i, 0.1, -0.3) for i in range(4)], spinning(), noise, 40.0)
    assert not certain(found)[1:].any()
    assert all("shift along (1.00, 0.0" in row["unobserved"] for row in found.rows[1:])
    assert any("frames 1 to 3: shift along (1.00, 0.0" in line for line in found.summary())


def test_standing_in_a_tunnels_mouth_it_stays_where_it_is():
    ground = wall(2, -2.0, lambda p: (p[:, 0] > 0) | (np.abs(p[:, 1]) < 3))
    found, truth = drive([tunnel(4.0, end=0.0), ground], [placed(0.5)] * 5, spinning(), 0.02, 60.0)
    assert errors(found, truth)[0].max() < 0.1


def test_open_ground_leaves_three_motions_open():
    found, _ = drive([wall(2, -2.0)], [placed(0.8 * i) for i in range(3)], spinning(), 0.02, 80.0)
    assert not certain(found)[1:].any()
    assert found.rows[1]["unobserved"].count("shift along") == 2
    assert "rotation about (0.00, 0.00, 1.00)" in found.rows[1]["unobserved"]


@pytest.mark.slow
def test_through_a_tunnel_it_goes_on_as_it_came_and_says_where_it_did_not_see():
    """Parked cars before and behind 30 m of tube, 1.2 m a frame; reach 15 m."""
    rng = np.random.default_rng(1)
    cars = [
        block((x, y, -2.0), (x + rng.uniform(2, 4), y + 2, rng.uniform(-1, 3)))
        for x in [*np.arange(-30, -3, 5.0), *np.arange(34, 60, 5.0)]
        for y in (-rng.uniform(5, 6), rng.uniform(3, 4))
    ]
    floor = wall(2, -2.0, lambda p: (p[:, 0] < 0) | (p[:, 0] > 30) | (np.abs(p[:, 1]) < 3.4))
    poses = [placed(-14.0 + 1.2 * i, 0.3) for i in range(50)]
    found, truth = drive([*cars, floor, tunnel(4.0, 0.0, 30.0)], poses, spinning(), 0.02, 15.0)
    sure, (shift, angle) = certain(found), errors(found, truth)
    assert sure[:8].all()
    assert sure[-8:].all()
    assert not sure.all()
    assert shift[:8].max() < 0.03
    assert shift.max() < 0.1 * 30  # 30 m without a landmark
    assert angle.max() < 0.5
    uncertain = [row for row in found.rows if row["status"] != "aligned"]
    assert all(row["unobserved"].startswith("shift along (1.00") for row in uncertain)
    largest = max(row["sigma_shift"] for row in uncertain)
    assert shift.max() < 3 * largest


def test_rings_across_a_corridors_floor_and_ceiling_hold_height_and_tilt():
    """16 beams: floor and ceiling are single rings, far apart; boxes on the walls tell the way along it."""
    things = [wall(1, 1.2), wall(1, -1.2), wall(2, -1.0), wall(2, 1.8)]
    things += [block((x, 1.0, -1.0), (x + 0.5, 1.2, 0.8)) for x in range(-20, 30, 4)]
    things += [block((x, -1.2, -1.0), (x + 0.7, -0.95, 0.5)) for x in range(-17, 30, 5)]
    poses = [placed(0.24 * i, 0.02 * i) for i in range(8)]
    found, truth = drive(things, poses, spinning(16, 900, -15.0, 15.0), 0.02, 60.0)
    shift, angle = errors(found, truth)
    assert certain(found)[2:].all()  # the first motion of all is the hardest
    assert shift[2:].max() < 0.05
    assert angle[2:].max() < 0.7


def test_a_camera_along_a_corridor_is_held_by_what_stands_out_from_its_walls():
    """Cupboards a hand deep, seen in a few dozen points: starts on both sides find back to one pose."""
    scene, corners = passages(np.random.default_rng(0), 24.0, 16.0, 2.4, 0.0)
    walk = Drive(scene, Way(corners, 0.8, wobble=0.5), depth_camera(), 10.0)
    found, truth = align_sequence(list(islice(walk.scans(), 8))), walk.truth()[:8]
    sure, (shift, _) = certain(found), errors(found, truth)
    assert sure.sum() >= 5
    assert shift[sure].max() < 0.05


def test_a_camera_that_pans_past_a_blank_wall_is_right_or_says_so():
    things = [
        wall(1, 2.5), wall(0, 2.2), wall(1, -2.6), block((0.2, -2.6, -1), (0.8, -2, 0.1)),
        block((1, -2.2, -1), (1.3, -1.9, -0.2)), block((2, -2, -1), (2.2, -1.2, 1)),
        block((0.5, 2.2, -1.2), (1, 2.5, 0)), block((1.4, -1, -1.2), (2, -0.6, -0.6)),
    ]  # fmt: skip
    found, truth = drive(things, [placed(0, yaw=-60 + 12 * i) for i in range(12)], camera(), 0.005, 6.0)
    sure, (shift, angle) = certain(found), errors(found, truth)
    assert sure[:4].all()
    assert not sure.all()
    assert shift[sure].max() < 0.05
    assert angle[sure].max() < 0.5
    assert shift.max() < 0.1


@pytest.mark.slow
def test_the_cases_of_the_shared_data(shared_data):
    cases = shared_data / "cases" / "sequences"
    found = align_sequence(cases / "pan")
    truth = read_poses(cases / "pan_truth.txt")
    sure, (shift, angle) = certain(found), errors(found, np.linalg.inv(truth[0]) @ truth)
    assert shift[sure].max() < 0.05
    assert angle[sure].max() < 0.5
    assert sure.sum() >= 5
    found = align_sequence(cases / "tunnel")
    assert not certain(found)[1:].any()
    assert all("shift along (0.00, 1.00, 0.00)" in row["unobserved"] for row in found.rows[1:])


@pytest.mark.parametrize("folder", ["kitti_seq/velodyne", "hdl64"])
def test_nothing_is_called_open_on_a_street(shared_data, folder):
    files = sorted(f for f in (shared_data / folder).iterdir() if f.suffix in (".bin", ".pcd"))[:6]
    found = align_sequence(files)
    assert certain(found).all()
    assert not any("unobserved" in row for row in found.rows)


def planes(*normals, tilt=0.0, count=400):
    """Points on planes through a cube with these normals, and both sides' normals, wrong by ``tilt`` radians each."""
    rng = np.random.default_rng(0)
    points, truth = [], []
    for n in np.eye(3)[list(normals)]:
        flat = rng.uniform(-10, 10, (count, 3))
        points.append(flat - np.outer(flat @ n - 10, n))
        truth.append(np.tile(n, (count, 1)))
    n = np.concatenate(truth)
    sides = [m / np.linalg.norm(m, axis=1, keepdims=True) for m in (n + rng.normal(0, tilt, n.shape) for _ in "ab")]
    return Matches(np.arange(len(n)), np.concatenate(points), *sides, np.ones(len(n)), 0.05, np.zeros(len(n)))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_planes_leave_open_what_they_do_not_face(tilt):
    def unobserved(*normals):
        matches = planes(*normals, tilt=tilt)
        return observe(matches, np.ones(len(matches.index)), WRONG).unobserved

    assert unobserved(0, 1, 2) == []
    assert len(unobserved(1, 2)) == 1
    assert unobserved(1, 2)[0].startswith("shift along (1.00, ")
    assert len(unobserved(2)) == 3


def test_directions_in_words():
    twists = np.array([[0, 0, 0.1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, -2, 0]], float).T
    said = in_words(twists @ np.array([[1, 1, 0], [0.5, -1, 1], [0.2, 0, 3]]), 10.0)
    assert [words.split(" (")[0] for words in said] == ["shift along", "shift along", "rotation about"]
    assert said[2] == "rotation about (0.00, 0.00, 1.00)"


def test_poses_aside_move_the_points_along_what_is_open_alone():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-5, 5, (4000, 2)), np.zeros(4000)])
    up = np.tile([0.0, 0.0, 1.0], (4000, 1))
    seen = observe(Matches(np.arange(4000), points, up, up, np.ones(4000), 0.01, np.zeros(4000)), np.ones(4000), WRONG)
    poses = seen.aside(np.eye(4), 2.0)
    assert len(poses) == 6  # to both sides along the two shifts and the rotation within the plane
    for T in poses:
        moved = points @ T[:3, :3].T + T[:3, 3] - points
        assert np.sqrt((moved**2).sum(1).mean()) == pytest.approx(2.0, rel=0.1)
        assert np.abs(moved[:, 2]).max() < 0.05
