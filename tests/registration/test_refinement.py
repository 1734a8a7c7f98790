"""The last step suits what the scans are: two noisy ones are smoothed, a clean one keeps its own planes."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli import PointCloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.registration import Options, prepare, refinement
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.synthetic.near_pairs import Degraded, near_pair, two_sensors


def pair_of(number: int, swapped: bool) -> tuple[Pair, np.ndarray, np.ndarray]:
    """A noisy depth camera onto a clean laser scanner, or the other way about; the true pose and one near it."""
    near = near_pair(two_sensors(np.random.default_rng(number), 6000), Degraded(0.01, 0.0), np.random.default_rng(9))
    clouds, true, start = (near.source, near.target), near.T_target_source, near.start
    if swapped:
        clouds, true, start = clouds[::-1], np.linalg.inv(true), np.linalg.inv(start)
    pair = make_pair(*(prepare(PointCloud(points)) for points in clouds), Options())
    return pair, pair.enter_centred(true), refinement.by_planes(pair, pair.enter_centred(start))


@pytest.mark.parametrize("swapped", [False, True], ids=["noisy source", "noisy target"])
def test_between_a_noisy_and_a_clean_scan_the_planes_of_the_clean_one_count(swapped: bool) -> None:
    off = []
    for number in range(5):
        pair, true, start = pair_of(number, swapped)
        assert refinement.noisy(pair)
        s, t = pair.source.fine(refinement.GICP_SOURCE, pair.edge), pair.target.fine(refinement.GICP_TARGET, pair.edge)
        found = refinement.by_geometry(pair, start), refinement.by_smoothed(pair, start, s, t)
        off.append([angle_degrees(np.linalg.inv(true) @ T) for T in found])
    ours, smoothed = np.median(off, axis=0)
    assert ours < 0.85 * smoothed
