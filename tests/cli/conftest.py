"""What the tests of the command share: the command as a real process, and the sample scans with their truth."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.cli.app import main
from fmr_cli.geometry.pose_error import pose_error as error_of_pose

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.fixture(scope="session")
def fmr() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs `fmr` with the given arguments in the folder ``cwd``, as a user's shell would."""

    def run(*arguments: object, cwd: Path = SAMPLES) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "fmr_cli.cli", *map(str, arguments)]
        environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1"}
        return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)

    return run


@pytest.fixture
def fmr_here(monkeypatch, capsys) -> Callable[..., subprocess.CompletedProcess[str]]:
    """The same within this process: for what needs no process of its own, since torch takes long to import."""

    def run(*arguments: object, cwd: Path = SAMPLES) -> subprocess.CompletedProcess[str]:
        command = ["fmr", *map(str, arguments)]
        monkeypatch.setattr(sys, "argv", command)
        monkeypatch.chdir(cwd)
        monkeypatch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as end:
            main()
        return subprocess.CompletedProcess(command, end.value.code, *capsys.readouterr())

    return run


@pytest.fixture(scope="session")
def samples() -> Path:
    """The folder of the two sample scans: scan_a.ply, scan_b.ply, truth.txt."""
    return SAMPLES


@pytest.fixture(scope="session")
def truth() -> np.ndarray:
    """T_target_source of scan_a (source) onto scan_b (target)."""
    return np.loadtxt(SAMPLES / "truth.txt")


@pytest.fixture(scope="session")
def pose_error() -> Callable[[np.ndarray, np.ndarray], tuple[float, float]]:
    """Degrees and length between two poses."""
    return error_of_pose
