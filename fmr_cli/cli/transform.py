"""`fmr transform`: a saved transform applied, another coordinate system, a part of space, any format to any other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmr_cli.cli.console import points_bar, warn
from fmr_cli.cli.options import BinColumns, Bounds, Resolution, Topic, columns
from fmr_cli.errors import FmrError


def transform_command(
    file: Annotated[Path, typer.Argument(help="The cloud (or mesh) to move.", show_default=False)],
    transform: Annotated[
        Path | None,
        typer.Argument(help="The 4x4 transform: .txt, .npy or .json; without it the points stay.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="The moved cloud; the suffix says the format.")
    ] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="Apply the inverse of the transform.")] = False,
    crs: Annotated[
        str | None, typer.Option(help="Reproject to another coordinate system, such as EPSG:32633; needs pyproj.")
    ] = None,
    bounds: Bounds = None,
    resolution: Resolution = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no warnings.")] = False,
    bin_columns: BinColumns = None,
    topic: Topic = None,
) -> None:
    """Move FILE by a saved TRANSFORM and write it in any format. FILE#2 or FILE#name is one scan of several."""
    import numpy as np

    from fmr_cli import io
    from fmr_cli.io import outputs
    from fmr_cli.io.crs import reprojected
    from fmr_cli.vectors import find_vectors

    if out is None:
        raise FmrError("-o is missing: give the name of the file to write")
    outputs.check_outputs([(out, io.WRITABLE)])
    stream = io.open_cloud(file, bin_columns=columns(bin_columns), bounds=bounds, resolution=resolution, topic=topic)
    warnings = []
    if transform is not None:
        T = io.read_transform(transform, mirror=True)
        stream = stream.transformed(np.linalg.inv(T) if inverse else T)
    if crs is not None:
        stream = reprojected(stream, crs)
        if find_vectors(stream.survey.head.attributes):
            warnings.append(f"vectors of {file} keep the directions that they have in the old coordinate system")
    with points_bar(f"writing {out.name}", quiet) as count:
        warnings += io.write_cloud(out, count(stream))
    warn(*warnings, quiet=quiet)
