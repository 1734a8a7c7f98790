"""Fixtures of all tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

SHARED_DATA = Path(__file__).parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scans beside the repository; tests that need it are skipped where it is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real scans are not there: {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def room_scans() -> tuple[np.ndarray, np.ndarray]:
    """Two scans (12,000, 3) of one procedural room in its frame, metres, z up; 57 % of their points overlap."""
    from fmr_cli.synthetic import scenes

    rng = np.random.default_rng(1)
    room = scenes.room(rng)
    eye = np.array([0.0, 0.0, 1.4])
    walk = ((eye, 1.0), (eye + np.array([0.4, 0.3, 0.0]), 1.5))
    first, second = (rng.permutation(scenes.room_scan(room, rng, place, heading))[:12_000] for place, heading in walk)
    return first, second
