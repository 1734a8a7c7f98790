"""The `fmr` command, put together from a module a command.

Exit codes: 0 done (every result `aligned`), 2 bad input (one line says what), 3 a result is written but `uncertain`.
Heavy imports stay inside the commands, so that `fmr --help` starts at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable

import typer

from fmr_cli import __version__
from fmr_cli.cli.align import align_command
from fmr_cli.cli.batch import batch_command
from fmr_cli.cli.console import BAD_INPUT, complain
from fmr_cli.cli.evaluate import evaluate_command
from fmr_cli.cli.example import example_command
from fmr_cli.cli.info import info_command
from fmr_cli.cli.multiway import multiway_command
from fmr_cli.cli.options import Debug, takes_debug
from fmr_cli.cli.sequence import sequence_command
from fmr_cli.cli.train import train_command
from fmr_cli.cli.transform import transform_command
from fmr_cli.cli.view import view_command
from fmr_cli.errors import FmrError

app = typer.Typer(
    help="Feature-metric point cloud registration: two scans in, the right transform out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
COMMANDS: dict[str, Callable[..., None]] = {
    "align": align_command,
    "batch": batch_command,
    "multiway": multiway_command,
    "sequence": sequence_command,
    "info": info_command,
    "transform": transform_command,
    "view": view_command,
    "train": train_command,
    "evaluate": evaluate_command,
    "example": example_command,
}
for name, command in COMMANDS.items():
    app.command(name)(takes_debug(command))


@app.callback(invoke_without_command=True)
def root(
    version: bool = typer.Option(False, "--version", help="Print the version and exit."), debug: Debug = False
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


def main() -> None:
    """Run the command; an FmrError or OSError becomes one line on stderr and exit code 2.

    With --debug, before the command or after it, the traceback is shown instead of the line.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's products are small here; its threads only wait
    # torch's threads sleep while one waits for another: spinning, they keep the other one off a core that is shared.
    # Beside other work 60 steps of `train` took 92 s so and 7 to 12 s asleep.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        app()
    except (FmrError, OSError) as error:
        if "--debug" in sys.argv:
            traceback.print_exc()
        else:
            complain(error)
        sys.exit(BAD_INPUT)


if __name__ == "__main__":
    main()
