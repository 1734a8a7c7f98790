"""Loops: found where the path comes back, verified by registration, and closed without moving the first frame."""

from __future__ import annotations

import numpy as np
import pytest
from degenerate import block, placed, seen, spinning, wall
from simulation import drive, make_street, scan

from fmr_cli.sequence import loop_closure
from fmr_cli.sequence.loop_closure import Loop, believed, close_loops, confirmed, path_lengths
from fmr_cli.sequence.prepared_scan import PreparedScan

pytest.importorskip("gtsam")
VOXEL = 0.4


@pytest.mark.slow
def test_a_drifted_round_is_closed(monkeypatch):
    monkeypatch.setattr(loop_closure, "LOOKALIKES", 3)  # far apart by the path: the most promising, to be quick
    place, poses, rng = make_street(60), drive(60)[::10], np.random.default_rng(3)
    truth = np.linalg.inv(poses[0]) @ poses
    scans = {}

    def load(index):
        if index not in scans:
            scans[index] = PreparedScan(scan(place, poses[index], rng, columns=450) / VOXEL, np.zeros(3))
        return scans[index]

    drifted = truth.copy()
    drifted[:, :3, 3] /= VOXEL
    drifted[:, :3, 3] += np.linspace(0, 1, len(poses))[:, None] * [4.0, -3.0, 1.0]
    closed, loops = close_loops(drifted, np.ones(len(poses), bool), load)
    assert any(loop.expected for loop in loops)
    assert all(abs(loop.later - loop.earlier) > len(poses) / 2 for loop in loops)
    assert np.array_equal(closed[0].round(9), np.eye(4))
    assert np.linalg.norm(closed[-1][:3, 3] * VOXEL - truth[-1][:3, 3]) < 0.2  # of 2 m
    assert np.linalg.norm(closed[:, :3, 3] * VOXEL - truth[:, :3, 3], axis=1).max() < 1.2


@pytest.mark.slow
def test_a_corridor_that_repeats_is_no_loop(monkeypatch):
    """34 m of bays that are all alike: every place looks like every other one, and none is seen twice."""
    things = [wall(1, 1.5), wall(1, -1.5), wall(2, -1.2), wall(2, 1.6)]
    for x in range(-30, 100, 3):
        things += [block((x, 1.1, -1.2), (x + 0.5, 1.5, 1.6)), block((x + 1.5, -1.5, -1.2), (x + 2.0, -1.0, 0.4))]
    poses, rng = np.array([placed(2.0 * i) for i in range(18)]), np.random.default_rng(0)
    scans = [PreparedScan(seen(things, T, spinning(), rng, 0.01, 25.0) / 0.2, np.zeros(3)) for T in poses]
    poses[:, :3, 3] /= 0.2
    monkeypatch.setattr(loop_closure, "LOOKALIKES", 3)  # the most promising, to be quick
    closed, loops = close_loops(poses, np.ones(len(poses), bool), scans.__getitem__)
    assert loops == []
    assert np.array_equal(closed, poses)


def far_loop(earlier, later, T_earlier_later):
    return Loop(earlier, later, T_earlier_later, np.eye(6), between=3000.0, off=290.0, expected=False)


def measured(between, off, *, expected):
    return Loop(0, 1, np.eye(4), np.eye(6), between, off, expected)


def test_where_aisles_look_alike_none_is_taken_for_another():
    """No path of 110 voxels drifts by 27: what looks alike lies 27 apart here, and would be taken for a loop later."""
    alike, later = measured(110.0, 27.0, expected=True), measured(680.0, 56.0, expected=False)
    near, drifted = measured(500.0, 3.0, expected=True), measured(2000.0, 26.0, expected=True)
    assert believed([later, near, drifted]) == [later, near, drifted]
    assert believed([alike, later, near, drifted]) == [near]


def test_a_loop_far_off_the_path_needs_another_one_that_says_the_same():
    poses = np.array([placed(10.0 * i) for i in range(40)])
    far = [far_loop(0, 30, placed(5.0)), far_loop(2, 32, placed(5.5))]
    other = far_loop(4, 36, placed(120.0))
    path = path_lengths(poses)
    assert confirmed(far[0], [*far, other], poses, path)
    assert not confirmed(far[0], [far[0], other], poses, path)
