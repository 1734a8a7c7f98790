"""Made-up drives: a way that stays out of what stands beside it."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.synthetic.drives import Way, streets


@pytest.mark.parametrize("size", [(220, 120), (160, 100), (120, 80)])
def test_no_house_stands_on_the_way_round_the_streets(size):
    """Inside a house a scan sees its walls alone: a drive came out of one turned over."""
    scene, corners = streets(np.random.default_rng(0), *size)
    way = Way(corners, 1.0)
    eyes = way.poses(np.arange(0.0, way.length, 1.0))[:, :3, 3]
    for T in scene.maps:
        own = (eyes - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T
        assert not (np.abs(own) < 1).all(1).any()
