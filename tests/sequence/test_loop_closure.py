"""Loops: found where the path comes back, verified by registration, and closed without moving the first frame."""

from __future__ import annotations

import numpy as np
import pytest
from simulation import drive, make_street, scan

from fmr_cli.sequence.loop_closure import close_loops
from fmr_cli.sequence.prepared_scan import PreparedScan

pytest.importorskip("gtsam")
VOXEL = 0.4


def test_a_drifted_round_is_closed():
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
    assert loops
    assert np.array_equal(closed[0].round(9), np.eye(4))
    assert np.linalg.norm(closed[-1][:3, 3] * VOXEL - truth[-1][:3, 3]) < 0.2  # of 2 m
    assert np.linalg.norm(closed[:, :3, 3] * VOXEL - truth[:, :3, 3], axis=1).max() < 1.2
