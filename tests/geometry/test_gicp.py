"""Generalised ICP: the last geometric step of a rigid registration."""

from __future__ import annotations

import numpy as np
from simulation import turn_and_shift

from fmr_cli.geometry import gicp
from fmr_cli.geometry.point_to_plane import linearise, normal_equations
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


def test_what_gicp_goes_by_pulls_nowhere_at_its_pose_and_back_to_it_from_elsewhere(room_scans: Scans) -> None:
    source, target = (gicp.GicpCloud(points, EDGE) for points in room_scans)
    found = gicp.gicp(source, target, np.eye(4), EDGE)

    def step(T: np.ndarray) -> np.ndarray:
        seen = gicp.observed(source, target, T, EDGE)
        assert 0 < seen.weight.min() <= seen.weight.max() <= 1
        r, J = linearise(seen.x, seen.y, seen.normal, np.zeros(3))
        return -np.linalg.solve(*normal_equations(J, r, seen.weight))

    off = np.eye(4)
    off[:3, 3] = 0.004, -0.003, 0.002  # metres; the two scans' noise leaves a tenth of a millimetre of the pose open
    here, back = step(found), step(off @ found)
    assert np.abs(here).max() < 3e-4
    np.testing.assert_allclose(back[3:], -off[:3, 3], atol=1e-3)
