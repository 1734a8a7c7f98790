"""Where a scene repeats itself, the rivals of a pose are found from that pose alone."""

from __future__ import annotations

import numpy as np

from fmr_cli import PointCloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.registration.hypotheses import rivals
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.prepared import Prepared


def box_like() -> np.ndarray:
    """A block with two knobs, the same turned by half about z."""
    rng = np.random.default_rng(0)
    sides = np.array([1.0, 0.6, 0.35])
    points = rng.uniform(-1, 1, (12_000, 3))
    points[np.arange(12_000), rng.choice(3, 12_000, p=(1 / sides) / (1 / sides).sum())] = rng.choice([-1, 1], 12_000)
    knob = rng.normal(size=(1500, 3))
    knob = 0.15 * knob / np.linalg.norm(knob, axis=1, keepdims=True) + [0.6, 0.3, 0.35]
    return np.concatenate([points * sides, knob, knob * [-1, -1, 1]])


def test_half_a_turn_is_found_as_a_rival_of_the_true_pose() -> None:
    points = box_like()
    pair = make_pair(Prepared(PointCloud(points[::2])), Prepared(PointCloud(points[1::2])), Options())
    found, repeats = rivals(pair, pair.enter_centred(np.eye(4)))
    assert repeats > 0.3
    turned = [angle_degrees(h.T_target_source) for h in found]
    assert any(abs(angle - 180) < 10 for angle in turned)
