"""`fmr align`: one pair."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from fmr_cli.cli.console import UNCERTAIN, busy, points_bar, quick_imports, say, show_log, warn
from fmr_cli.cli.options import BinColumns, Verbose, columns, takes_registration_options
from fmr_cli.registration.options import Options


@takes_registration_options
def align_command(
    source: Annotated[Path, typer.Argument(help="The cloud that is moved.", show_default=False)],
    target: Annotated[Path, typer.Argument(help="The cloud that it is moved onto.", show_default=False)],
    options: Options,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="The 4x4 transform: .txt, .npy or .json; stdout if not given.")
    ] = None,
    aligned: Annotated[Path | None, typer.Option(help="The moved source, with each point's residual.")] = None,
    merged: Annotated[Path | None, typer.Option(help="Both clouds, with a source_id: 0 source, 1 target.")] = None,
    metrics: Annotated[Path | None, typer.Option(help="Everything said about the result, as .json.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the metrics to stdout, not the matrix.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary.")] = False,
    bin_columns: BinColumns = None,
    verbose: Verbose = 0,
) -> None:
    """Find the transform that moves SOURCE onto TARGET."""
    from fmr_cli import io
    from fmr_cli.io import outputs

    show_log(verbose)
    outputs.check_outputs([
        (out, (".txt", ".npy", ".json")), (aligned, io.WRITABLE), (merged, io.WRITABLE), (metrics, (".json",)),
    ])  # fmt: skip
    with busy(f"registering {source.name} onto {target.name}", quiet):
        from fmr_cli.registration.prepared import AT_MOST

        named = columns(bin_columns)
        moving, fixed = (
            io.read_cloud(path, attributes=False, at_most=AT_MOST, bin_columns=named) for path in (source, target)
        )
        with quick_imports():  # after reading: a bad file is said at once
            from fmr_cli.registration import align, export
        found = align(moving, fixed, options, check=bool(metrics or as_json or verbose))
    T, said, warnings = found.T_target_source, export.metrics(moving, fixed, found), [*found.warnings]
    files = [io.open_cloud(path, bin_columns=named) for path in (source, target)]
    if aligned:
        with points_bar("writing the moved source", quiet) as count:
            cloud = export.aligned_cloud(files[0], io.open_cloud(target, attributes=False, bin_columns=named), T)
            warnings += io.write_cloud(aligned, count(cloud))
    if merged:
        with points_bar("writing both clouds", quiet) as count:
            cloud, lacking = export.merged_cloud(files[0], files[1], T)
            warnings += lacking + io.write_cloud(merged, count(cloud))
    if metrics:
        outputs.write_json(metrics, said)
    if out:
        io.write_transform(out, T)
    if as_json:
        typer.echo(json.dumps(said, indent=2))
    elif not out:
        typer.echo(io.transform_text(T), nl=False)
    say(*export.summary(moving, fixed, found), quiet=quiet)
    warn(*warnings, quiet=quiet)
    if found.status != "aligned":
        raise typer.Exit(UNCERTAIN)
