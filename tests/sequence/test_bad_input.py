"""One scan that is not as the others are: it is placed or bridged, and nothing else is lost."""

from __future__ import annotations

import numpy as np
import pytest
from simulation import drive, make_street, scan

from fmr_cli import PointCloud
from fmr_cli.geometry.se3 import exp
from fmr_cli.sequence import align_sequence

OVER = exp(np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]))  # a scanner mounted upside down
ROUND = exp(np.array([0.0, 0.0, np.radians(200.0), 0.0, 0.0, 0.0]))  # it has spun more than half round


@pytest.fixture(scope="module")
def street_drive():
    """Eight scans of a drive that stands at first, and their true poses."""
    place, rng = make_street(60), np.random.default_rng(4)
    poses = drive(60, rest=0)[10:16]
    poses = np.concatenate([poses[:1], poses[:1], poses])
    return [scan(place, pose, rng, columns=450) for pose in poses], poses


def spoilt(scans, poses, how):
    """The scans and true poses with something odd at frame 5."""
    scans, poses = list(scans), poses.copy()
    if how == "upside down":
        scans[5], poses[5] = scans[5] @ OVER[:3, :3], poses[5] @ OVER
    elif how == "spun":
        scans[5:] = [points @ ROUND[:3, :3] for points in scans[5:]]
        poses[5:] = poses[5:] @ ROUND
    elif how == "doubled":
        scans[5], poses[5] = scans[4], poses[4]
    elif how == "blank":
        scans[5] = scans[5][:20]
    elif how == "another sensor":  # a narrow view, a sixth of the points
        ahead = np.abs(np.arctan2(scans[5][:, 1], scans[5][:, 0])) < np.radians(40)
        scans[5] = scans[5][ahead][::2]
    elif how == "gap":
        del scans[3:5]
        poses = np.delete(poses, [3, 4], axis=0)
    return [PointCloud(points) for points in scans], np.linalg.inv(poses[0]) @ poses


@pytest.mark.parametrize("how", [
    "upside down", "blank",
    *(pytest.param(how, marks=pytest.mark.slow) for how in ("spun", "doubled", "another sensor", "gap")),
])  # fmt: skip
def test_it_is_placed_or_bridged_and_nothing_else_is_lost(street_drive, how):
    scans, truth = spoilt(*street_drive, how)
    found = align_sequence(scans)
    shift = np.linalg.norm(found.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    sure = np.array([row["status"] == "aligned" for row in found.rows])
    assert set(np.flatnonzero(~sure)) <= {5}
    assert shift[sure].max() < 0.1
    assert shift.max() < 0.8  # as far as it drives in one frame
    assert np.abs(np.linalg.inv(truth[sure][:, :3, :3]) @ found.poses[sure][:, :3, :3] - np.eye(3)).max() < 0.02
    if how == "blank":
        assert "message" in found.rows[5]
