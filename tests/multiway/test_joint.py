"""The joint refinement's sigmas are true: errors against exact poses, in units of the covariance that is given."""

from __future__ import annotations

import numpy as np
from rooms import room_views

from fmr_cli import PointCloud
from fmr_cli.geometry.frames import enter_frames
from fmr_cli.geometry.motion import Motion, exp
from fmr_cli.multiway import joint
from fmr_cli.multiway.workers import Threads
from fmr_cli.registration import prepare


def test_poses_that_are_off_come_home():
    """A graph that is off by a third of a degree and 2 cm: a tenth of that is left at most."""
    clouds, truth = room_views(50, 3)
    ready = [prepare(PointCloud(points)) for points in clouds]
    edge, rng, workers = float(np.median([scan.edge for scan in ready])), np.random.default_rng(0), Threads(1)
    poses = {n: enter_frames(np.linalg.inv(truth[0]) @ truth[n], ready[n].frame, ready[0].frame) for n in range(3)}
    views = {n: joint.view(scan, edge) for n, scan in enumerate(ready)}
    off = {n: T @ exp(rng.choice([-1, 1], 6) * np.repeat([0.0034, 0.0115], 3)) if n else T for n, T in poses.items()}
    found = joint.refine(off, views, [(1, 0), (2, 0), (2, 1)], {0}, Motion(), workers)
    workers.close()
    for n in (1, 2):
        before, after = (joint.right_twist(poses[n], T[n]) for T in (off, found.T_component_scan))
        assert np.linalg.norm(after[:3]) < 0.1 * np.linalg.norm(before[:3])
        assert np.linalg.norm(after[3:]) < 0.1 * np.linalg.norm(before[3:])


def test_the_normalised_estimation_error_squared_is_about_its_dimension():
    squares, workers = [], Threads(1)
    for seed in range(50, 54):
        clouds, truth = room_views(seed, 5)
        ready = [prepare(PointCloud(points)) for points in clouds]
        edge = float(np.median([scan.edge for scan in ready]))
        poses = {n: enter_frames(np.linalg.inv(truth[0]) @ truth[n], ready[n].frame, ready[0].frame) for n in range(5)}
        views = {n: joint.view(scan, edge) for n, scan in enumerate(ready)}
        pairs = [(i, j) for i in range(5) for j in range(i)]
        found = joint.refine(poses, views, pairs, {0}, Motion(), workers)
        for n in range(1, 5):
            twist = joint.right_twist(poses[n], found.T_component_scan[n])
            squares.append(twist @ np.linalg.solve(found.covariance[n], twist))
    workers.close()
    assert 0.6 < np.mean(squares) / 6 < 2, "16 draws that hang together: 1 but for about 0.3"
