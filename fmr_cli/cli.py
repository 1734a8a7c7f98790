"""The `fmr` command: arguments in, one call of the library, a line for a person on stderr, an exit code.

Exit codes: 0 done (every result `aligned`), 2 bad input (one line says what), 3 a result is written but `uncertain`.
Heavy imports stay inside the commands, so that `fmr --help` starts at once.
"""

from __future__ import annotations

import sys

import typer
from rich.console import Console

from fmr_cli import __version__
from fmr_cli.errors import FmrError

app = typer.Typer(
    help="Feature-metric point cloud registration: two scans in, the right transform out, or a word that it is not sure.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
err = Console(stderr=True, highlight=False, soft_wrap=True)

UNCERTAIN = 3


@app.callback(invoke_without_command=True)
def root(version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


def main() -> None:
    """Run the command; an FmrError or OSError becomes one line on stderr and exit code 2."""
    try:
        app()
    except (FmrError, OSError) as error:
        err.print(f"fmr: {' '.join(str(error).split())}", style="red", markup=False)
        sys.exit(2)


if __name__ == "__main__":
    main()
