"""The pairs that the verdict learns from: every kind in turn, many of them bent, the same every time."""

from __future__ import annotations

import numpy as np

from fmr_cli.synthetic.calibration_pairs import BENDS, DRAWN, bent, calibration_pair
from fmr_cli.synthetic.verdict_pairs import KINDS


def test_every_kind_has_its_turn_and_comes_out_the_same():
    assert set(DRAWN) == set(KINDS)
    number = DRAWN.index("overlap")
    a, b = (calibration_pair(3, number) for _ in range(2))
    assert a.kind == "overlap"
    assert (a.source == b.source).all()
    assert (a.target == b.target).all()


def test_a_bend_moves_points_by_its_amplitude_at_most():
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    moved = np.linalg.norm(bent(points, BENDS[1], np.random.default_rng(1)) - points, axis=1)
    assert 0 < moved.max() < 4 * BENDS[1] * 2
    assert np.ptp(moved) > 0
