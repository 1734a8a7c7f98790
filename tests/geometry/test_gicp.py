"""Generalised ICP: the last geometric step of a rigid registration."""

from __future__ import annotations

import numpy as np
from simulation import turn_and_shift

from fmr_cli.geometry import gicp
from fmr_cli.geometry.pose_error import pose_error

Scans = tuple[np.ndarray, np.ndarray]
EDGE = 0.08  # of the voxels, metres


def test_gicp_makes_a_near_pose_exact(room_scans: Scans) -> None:
    truth = turn_and_shift(40, 1.0)
    source = (room_scans[0] - truth[:3, 3]) @ truth[:3, :3]
    start = turn_and_shift(1.5, 0.05, (0.8, 0.0, 0.6)) @ truth
    first, second = (
        gicp.gicp(gicp.GicpCloud(source, EDGE), gicp.GicpCloud(room_scans[1], EDGE), start, EDGE) for _ in range(2)
    )
    degrees, metres = pose_error(first, truth, (1.0, 1.0, 1.0))
    assert degrees < 0.1
    assert metres < 0.01
    assert np.array_equal(first, second)
