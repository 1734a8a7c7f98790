"""Photogrammetric clouds: on their targets by the truth, with rounded edges, holes and a scale of their own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.synthetic.cross_source import SCALE, SENSORS, cross_source_pair, photogrammetric


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_truth_lays_one_cloud_on_the_other(sensor: str) -> None:
    scales = []
    for number in range(2):
        pair = cross_source_pair(sensor, 0.5, np.random.default_rng(number))
        home = transform_points(pair.T_target_source, pair.source)
        apart = cKDTree(home).query(pair.target)[0] / pair.size
        assert np.median(apart) < 0.015
        assert np.cbrt(np.linalg.det(pair.T_target_source[:3, :3])) == pytest.approx(pair.scale)
        assert SCALE[0] <= pair.scale <= SCALE[1]
        scales.append(pair.scale)
    assert scales[0] != scales[1]


def test_defects_grow_with_the_strength() -> None:
    rng = np.random.default_rng(0)
    cube = rng.uniform(-1, 1, (12_000, 3))
    cube[np.arange(len(cube)), rng.integers(0, 3, len(cube))] = rng.choice([-1.0, 1.0], len(cube))
    assert photogrammetric(cube, 2.0, 0.0, rng) is cube
    weak, strong = (photogrammetric(cube, 2.0, strength, np.random.default_rng(1)) for strength in (0.5, 2.0))
    assert len(strong) < len(weak) < len(cube)
    off = [np.abs(np.abs(x).max(1) - 1).mean() for x in (weak, strong)]
    assert 0 < 2 * off[0] < off[1]
    missing = [cKDTree(x).query(cube)[0].max() for x in (weak, strong)]
    assert missing[1] > 0.16  # a patch of 0.08 of the size at least, to its middle
