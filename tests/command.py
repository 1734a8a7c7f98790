"""The command `fmr` for tests: within this process, or as a process of its own."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

from fmr_cli.cli.app import main

SAMPLES = Path(__file__).parents[1] / "samples"
USUAL = {"COLUMNS": "200", "NO_COLOR": "1"}

Done = subprocess.CompletedProcess[str]


def here(*arguments: object, cwd: Path = SAMPLES) -> Done:
    """`fmr` with these arguments in the folder ``cwd``, within this process: to start one takes a second."""
    command, out, err, code = ["fmr", *map(str, arguments)], io.StringIO(), io.StringIO(), None
    with (
        mock.patch.object(sys, "argv", command), mock.patch.dict(os.environ, USUAL), contextlib.chdir(cwd),
        contextlib.redirect_stdout(out), contextlib.redirect_stderr(err),
    ):  # fmt: skip
        try:
            main()
        except SystemExit as end:
            code = end.code
    assert isinstance(code, int), "the command ends with an exit code"
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


def as_process(*arguments: object, cwd: Path = SAMPLES) -> Done:
    """The same as a user's shell would run it: for what only that shows."""
    environment = {**os.environ, **USUAL}
    return subprocess.run(process_of(*arguments), cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def process_of(*arguments: object) -> list[str]:
    """What starts `fmr` with these arguments."""
    return [sys.executable, "-m", "fmr_cli.cli", *map(str, arguments)]
