"""`fmr example`: made-up scans with their truth, to try the other commands on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from fmr_cli.cli.console import say
from fmr_cli.cli.options import Quiet
from fmr_cli.errors import FmrError


def example_command(
    kind: Annotated[
        Literal["pair", "building", "drive"],
        typer.Argument(help="Two scans of a room, a building's, or a LiDAR's along a street.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The folder to make.", show_default=False)],
    scans: Annotated[int | None, typer.Option(help="How many.", min=2, show_default="2, 20 or 60")] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same scans.", min=0)] = 0,
    quiet: Quiet = False,
) -> None:
    """Write made-up scans and their true poses to a folder, to try things on."""
    from fmr_cli.synthetic.examples import EXAMPLES

    write, usual, most = EXAMPLES[kind]
    count = usual if scans is None else scans
    if count > most:
        raise FmrError(f"--scans {count}: the example {kind} has {most} at most")
    if out.is_dir() and any(out.iterdir()):
        raise FmrError(f"{out}: is not empty, give a new folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FmrError(f"{out}: cannot make this folder ({error.strerror}); give another --out") from None
    written = write(out, count, seed)
    say(f"{len(written)} scans: {out}", quiet=quiet)
