"""What a scan sees through, from where it was taken, and the main directions of what people build."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rooms import room_views
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud
from fmr_cli.geometry.frames import enter_frames
from fmr_cli.geometry.motion import Motion
from fmr_cli.multiway import candidates, planes, visibility
from fmr_cli.multiway.directions import main_directions, turned
from fmr_cli.registration import prepare


@pytest.fixture(scope="module")
def pair():
    clouds, truth = room_views(7, 2, points=60_000, columns=360)
    ready = [prepare(PointCloud(points)) for points in clouds]
    return ready, truth, [visibility.view(scan, ready[0].edge) for scan in ready]


def test_the_viewpoint_is_found_from_the_scan_alone(pair):
    ready, truth, views = pair
    for k in range(2):
        eye = np.array([0.7 * np.cos(k), 0.7 * np.sin(k), 1.4 + 0.05 * k, 1.0])
        there = ready[k].frame.enter((np.linalg.inv(truth[k]) @ eye)[None, :3])[0]
        assert np.linalg.norm(views[k].viewpoint - there) < 0.6


def test_a_scan_sees_through_another_one_only_at_a_wrong_pose(pair):
    ready, truth, views = pair
    T = enter_frames(np.linalg.inv(truth[1]) @ truth[0], ready[0].frame, ready[1].frame)
    right = visibility.compare(*views, T)
    assert right.agreeing > 1000
    assert right.contradiction < 0.5
    wrong = T.copy()
    wrong[:3, 3] += truth[1][:3, :3].T @ [0.8, 0.0, 0.0]
    assert visibility.compare(*views, wrong).contradiction > 2


def test_what_a_scan_is_too_sparse_to_see_through_is_no_agreement(pair):
    ready, truth, views = pair
    T = enter_frames(np.linalg.inv(truth[1]) @ truth[0], ready[0].frame, ready[1].frame)
    sparse = replace(views[1], count=np.minimum(views[1].count, visibility.SEEN - 1))
    assert visibility.seen_by(views[1], views[0], T, 4000).agreeing > 500
    assert visibility.seen_by(sparse, views[0], T, 4000) == visibility.Seen(0, 0, 0)


def test_rooms_back_to_back_share_a_wall_but_not_a_side_of_it(pair):
    ready, truth, views = pair
    points = ready[0].frame.leave(views[0].tree.data) @ truth[0][:3, :3].T + truth[0][:3, 3]
    beyond = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about the upright through the room's last wall along x
    beyond[0, 3] = 2 * points[:, 0].max()
    beyond[1, 3] = points[:, 1].min() + points[:, 1].max()
    T = enter_frames(np.linalg.inv(truth[1]) @ beyond @ truth[0], ready[0].frame, ready[1].frame)
    seen = visibility.compare(*views, T)
    assert seen.through < 0.01 * seen.behind
    assert seen.behind > 3 * seen.agreeing
    assert seen.contradiction > 2


def test_the_main_directions_of_a_room_are_its_walls_and_a_ball_has_none(pair):
    ready, truth, _ = pair
    found = main_directions(ready[0].surface(ready[0].edge).normals)
    assert found is not None
    walls = np.abs(truth[0][:3, :3] @ found)  # of a room whose walls lie along x, y and z
    assert np.allclose(np.sort(walls.max(0)), 1, atol=2e-3)
    ball = np.random.default_rng(0).normal(size=(5000, 3))
    assert main_directions(ball / np.linalg.norm(ball, axis=1, keepdims=True)) is None


def test_few_right_matches_among_many_wrong_ones_tell_the_shift_once_directions_do_the_rotation():
    rng = np.random.default_rng(3)
    source, R, t = rng.uniform(-20, 20, (300, 3)), Rotation.random(random_state=1).as_matrix(), np.array([5.0, -7, 3])
    target = rng.uniform(-20, 20, (300, 3))
    target[:20] = source[:20] @ R.T + t + rng.normal(0, 0.3, (20, 3))
    similarity = rng.uniform(0, 1, (300, 300))
    similarity[range(20), range(20)] = 2.0
    poses = turned(source, target, similarity, (np.eye(3), R), Motion())
    off = [np.linalg.norm(T[:3, 3] - t) + np.linalg.norm(T[:3, :3] - R) for T in poses]
    assert min(off) < 0.5
    level = turned(source, target, similarity, (np.eye(3), R), Motion("translation"))
    assert len(level) == 0, "a rotation that is not allowed is not proposed"
    assert len(turned(source, target, similarity, (None, R), Motion())) == 0


def test_planes_alone_tell_where_a_bare_corridor_goes_on():
    """Two scans of an L of bare walls, from either leg: nothing to describe, but planes; views tell the right pose."""
    rng = np.random.default_rng(5)
    walls = [  # an L of corridors, 2 m wide, 2.6 high: axis that is constant, its value, ends along the others
        (1, 0.0, (0, 12), (0, 2.6)), (1, 2.0, (2, 12), (0, 2.6)), (0, 0.0, (0, 9), (0, 2.6)),
        (0, 2.0, (2, 9), (0, 2.6)), (0, 12.0, (0, 2), (0, 2.6)), (1, 9.0, (0, 2), (0, 2.6)),
    ]  # fmt: skip
    points, normals = [], []
    for axis, at, along, up in walls:
        x = np.empty((6000, 3))
        x[:, axis], x[:, 1 - axis], x[:, 2] = at, rng.uniform(*along, 6000), rng.uniform(*up, 6000)
        points.append(x)
        normals.append(np.tile(np.eye(3)[axis], (6000, 1)))
    for z in (0.0, 2.6):
        for low, high in (((0, 0), (12, 2)), ((0, 2), (2, 9))):
            points.append(np.column_stack([rng.uniform(low, high, (9000, 2)), np.full(9000, z)]))
            normals.append(np.tile(np.eye(3)[2], (9000, 1)))
    world, facing = np.concatenate(points), np.concatenate(normals)
    frames = [np.eye(4), np.eye(4)]
    frames[1][:3, :3], frames[1][:3, 3] = Rotation.from_euler("zyx", [2.0, 0.4, -0.3]).as_matrix(), [3.0, -1, 2]
    views, directions = [], []
    for T, eye, kept in zip(frames, ([6.0, 1, 1.5], [1.0, 5, 1.5]), (world[:, 1] <= 2, world[:, 0] <= 2), strict=True):
        x, n = world[kept] @ T[:3, :3].T + T[:3, 3], facing[kept] @ T[:3, :3].T
        order = rng.permutation(len(x))
        x, n = x[order], n[order]
        place = T[:3, :3] @ eye + T[:3, 3]
        n = visibility.towards(place, x, n)
        nearest, count = visibility.range_image(x - place)
        some = visibility.SAMPLE
        views.append(visibility.Viewed(0.07, cKDTree(x), n, x[:some], n[:some], place, 0.0, nearest, count))
        directions.append(main_directions(n))
    true = frames[1] @ np.linalg.inv(frames[0])
    found = planes.poses(views[0], views[1], (directions[0], directions[1]), Motion())
    seen = [visibility.compare(*views, T).contradiction for T in found]
    off = [np.linalg.norm((T - true)[:3, 3]) + np.linalg.norm((T - true)[:3, :3]) for T in found]
    right = int(np.argmin(off))
    assert off[right] < 0.3
    assert seen[right] < 2 * candidates.ROUGHLY
    elsewhere = [s for s, o in zip(seen, off, strict=True) if o > 1]
    assert len(elsewhere) > 20
    assert np.median(elsewhere) > 3 * candidates.ROUGHLY
    level = planes.poses(views[0], views[1], (directions[0], directions[1]), Motion("translation"))
    assert len(level) == 0, "a rotation that is not allowed is not proposed"
