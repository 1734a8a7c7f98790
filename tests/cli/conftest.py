"""What the tests of the command share: the command, here or as a process, and the sample scans with their truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import command
import numpy as np
import pytest

from fmr_cli.geometry.pose_error import pose_error as error_of_pose


@pytest.fixture(scope="session")
def fmr() -> Callable[..., command.Done]:
    """`fmr` within this process."""
    return command.here


@pytest.fixture(scope="session")
def fmr_process() -> Callable[..., command.Done]:
    """`fmr` as a process of its own."""
    return command.as_process


@pytest.fixture(scope="session")
def samples() -> Path:
    """The folder of the two sample scans: scan_a.ply, scan_b.ply, truth.txt."""
    return command.SAMPLES


@pytest.fixture(scope="session")
def truth() -> np.ndarray:
    """T_target_source of scan_a (source) onto scan_b (target)."""
    return np.loadtxt(command.SAMPLES / "truth.txt")


@pytest.fixture(scope="session")
def pose_error() -> Callable[[np.ndarray, np.ndarray], tuple[float, float]]:
    """Degrees and length between two poses."""
    return error_of_pose
