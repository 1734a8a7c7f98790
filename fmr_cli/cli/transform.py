"""`fmr transform`: a saved transform applied, any format to any other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmr_cli.cli.console import warn


def transform_command(
    file: Annotated[Path, typer.Argument(help="The cloud (or mesh) to move.", show_default=False)],
    transform: Annotated[Path, typer.Argument(help="The 4x4 transform: .txt, .npy or .json.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="The moved cloud; the suffix says the format.")],
    inverse: Annotated[bool, typer.Option("--inverse", help="Apply the inverse of the transform.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No warnings.")] = False,
) -> None:
    """Move FILE by a saved TRANSFORM and write it in any format."""
    import numpy as np

    from fmr_cli import io
    from fmr_cli.io import outputs

    outputs.check_outputs([(out, io.WRITABLE)])
    T = io.read_transform(transform)
    warnings = io.write_cloud(out, io.read_cloud(file).transformed(np.linalg.inv(T) if inverse else T))
    warn(*warnings, quiet=quiet)
