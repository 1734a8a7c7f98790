"""Scans of made-up rooms with exact truth, and one network of them that several tests look at."""

from __future__ import annotations

import numpy as np
import pytest
from rooms import room_views

from fmr_cli import PointCloud


@pytest.fixture(scope="session")
def room():
    """Four scans of a room that go round it, and their T_world_scan."""
    return room_views(3, 4)


@pytest.fixture(scope="session")
def network(room):
    from fmr_cli import align_many

    return align_many([PointCloud(points) for points in room[0]], workers=2)


@pytest.fixture(scope="session")
def worst_error():
    """Degrees and length of the worst pose of a network against T_world_scan, about the first scan's."""
    from fmr_cli.cloud import angle_degrees

    def worst(poses, truth):
        off = []
        for T, true in zip(poses, truth, strict=True):
            D = np.linalg.inv(np.linalg.inv(truth[0]) @ true) @ np.linalg.inv(poses[0]) @ T
            off.append((angle_degrees(D), np.linalg.norm(D[:3, 3])))
        return tuple(np.max(off, axis=0))

    return worst
