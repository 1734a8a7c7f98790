"""`fmr transform`: a saved transform applied, any format to any other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmr_cli.cli.console import points_bar, warn
from fmr_cli.cli.options import BinColumns, columns


def transform_command(
    file: Annotated[Path, typer.Argument(help="The cloud (or mesh) to move.", show_default=False)],
    transform: Annotated[Path, typer.Argument(help="The 4x4 transform: .txt, .npy or .json.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="The moved cloud; the suffix says the format.")],
    inverse: Annotated[bool, typer.Option("--inverse", help="Apply the inverse of the transform.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no warnings.")] = False,
    bin_columns: BinColumns = None,
) -> None:
    """Move FILE by a saved TRANSFORM and write it in any format."""
    import numpy as np

    from fmr_cli import io
    from fmr_cli.io import outputs

    outputs.check_outputs([(out, io.WRITABLE)])
    T = io.read_transform(transform)
    stream = io.open_cloud(file, bin_columns=columns(bin_columns)).transformed(np.linalg.inv(T) if inverse else T)
    with points_bar(f"writing {out.name}", quiet) as count:
        warnings = io.write_cloud(out, count(stream))
    warn(*warnings, quiet=quiet)
