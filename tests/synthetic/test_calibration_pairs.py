"""The pairs that the verdict learns from: scans of one scene overlap in its frame, and no scan is empty."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.synthetic import calibration_pairs
from fmr_cli.synthetic.calibration_pairs import LEAST_POINTS, bare_rooms, calibration_pair, clutter, faces, halves, seen


@pytest.mark.parametrize("maker", [bare_rooms, faces, halves])
def test_two_scans_of_one_scene_share_a_surface(maker):
    source, target = calibration_pairs.full_pair(maker, np.random.default_rng(3))
    assert min(len(source), len(target)) >= LEAST_POINTS
    near = 0.03 * np.ptp(target, axis=0).max()
    assert (cKDTree(target).query(source)[0] < near).mean() > 0.3


def test_both_kinds_of_pairs_are_made_and_repeat():
    together = [calibration_pair(np.random.default_rng((1, number)))[2] for number in range(12)]
    assert 0 < sum(together) < 12
    a, b = (calibration_pair(np.random.default_rng((1, 0))) for _ in range(2))
    assert (a[0] == b[0]).all()
    assert (a[1] == b[1]).all()


def test_a_camera_sees_one_side_of_a_sphere():
    sphere = np.random.default_rng(0).normal(size=(20_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    shown = seen(sphere, np.array([0, 0, 2.0]))
    assert 0.4 < len(shown) / len(sphere) < 0.6
    assert (shown[:, 2] > -0.3).mean() > 0.95  # at the rim, a cell may hold the far side alone


def test_clutter_adds_a_third_at_most_and_keeps_the_scan():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5000, 3))
    more = clutter(points, rng)
    assert (more[:5000] == points).all()
    assert 5000 < len(more) < 1.5 * 5000
