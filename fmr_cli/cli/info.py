"""`fmr info`: what is in a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from fmr_cli.cli.console import BAD_INPUT, busy, complain
from fmr_cli.cli.options import BinColumns, Bounds, Resolution, Topic, columns
from fmr_cli.errors import FmrError


def info_command(
    files: Annotated[list[Path], typer.Argument(help="Clouds or meshes.", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON array, one object a file.")] = False,
    bin_columns: BinColumns = None,
    bounds: Bounds = None,
    resolution: Resolution = None,
    topic: Topic = None,
) -> None:
    """Say what is in each of the FILES. FILE#2 or FILE#name is one scan of a file that holds several."""
    from fmr_cli import io
    from fmr_cli.io.describe import describe, table

    found = []
    for path in files:
        try:
            with busy(f"reading {path.name}", as_json):
                stream = io.open_cloud(
                    path, bin_columns=columns(bin_columns), bounds=bounds, resolution=resolution, topic=topic
                )
                found.append(describe(stream))
        except FmrError as error:
            complain(error)
            continue
        if not as_json:
            typer.echo(table(found[-1]))
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    if len(found) < len(files):
        raise typer.Exit(BAD_INPUT)
