"""The map of the last keyframes: what is forgotten leaves no trace."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.sequence import local_map
from fmr_cli.sequence.local_map import COARSE, FINE, LocalMap
from fmr_cli.sequence.prepared_scan import PreparedScan


@pytest.fixture(scope="module")
def scans():
    rng = np.random.default_rng(0)
    floor = rng.uniform([-15, -15, 0], [15, 15, 0.05], (4000, 3))
    wall = rng.uniform([-15, 8, 0], [15, 8.05, 10], (2000, 3))
    place = np.concatenate([floor, wall])
    return [PreparedScan(place + np.array([0.3 * k, 0, 0]), np.array([0.0, 0, 3])) for k in range(6)]


def test_once_the_oldest_keyframes_are_forgotten_the_map_is_that_of_the_others_alone(scans, monkeypatch):
    monkeypatch.setattr(local_map, "MAP_KEYFRAMES", 2)
    poses = [np.eye(4) + 0.1 * k * np.eye(4, k=3) for k in range(6)]
    grown, fresh = LocalMap(), LocalMap()
    for index in range(6):  # the first two are forgotten at the fourth, the next two at the sixth
        grown.insert(index, scans[index], poses[index])
    for index in (4, 5):
        fresh.insert(index, scans[index], poses[index])
    assert [keyframe.index for keyframe in grown.keyframes] == [4, 5]
    assert grown.later is None
    assert np.array_equal(grown.surface.planes.sums, fresh.surface.planes.sums)
    for edges in ((FINE,), (COARSE,)):
        a, b = (each.fit(scans[5], np.eye(4), edges, "prediction") for each in (grown, fresh))
        assert a.overlap == b.overlap
        assert np.array_equal(a.T_map_scan, b.T_map_scan)
