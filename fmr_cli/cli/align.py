"""`fmr align`: one pair."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fmr_cli.cli.console import UNCERTAIN, busy, points_bar, quick_imports, say, show_log, warn
from fmr_cli.cli.options import (
    PICTURES,
    BinColumns,
    Report,
    Verbose,
    check_picture,
    check_report,
    check_screen,
    columns,
    takes_registration_options,
)
from fmr_cli.registration.options import Options

if TYPE_CHECKING:
    from fmr_cli.cloud import PointCloud


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
    report: Report = None,
    picture: Annotated[Path | None, typer.Option(help="Before, after, a section, residuals: .png, .pdf, .svg.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Look at the result in a window.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the metrics to stdout, not the matrix.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary.")] = False,
    bin_columns: BinColumns = None,
    target_bounds: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X Y Z X Y Z", help="Only the part of the target between two corners, low and high."),
    ] = None,
    verbose: Verbose = 0,
) -> None:
    """Find the transform that moves SOURCE onto TARGET."""
    from concurrent.futures import ThreadPoolExecutor

    from fmr_cli import io
    from fmr_cli.io import outputs

    show_log(verbose)
    outputs.check_outputs([
        (out, (".txt", ".npy", ".json")), (aligned, io.WRITABLE), (merged, io.WRITABLE), (metrics, (".json",)),
        (report, (".html", ".htm")), (picture, PICTURES),
    ])  # fmt: skip
    check_report(report)
    check_picture(picture)
    check_screen(view)
    with busy(f"registering {source.name} onto {target.name}", quiet):
        from fmr_cli.registration.prepared import AT_MOST

        named = columns(bin_columns)
        boxes = (None, target_bounds)

        def read(path: Path, box: tuple[float, ...] | None) -> PointCloud:
            return io.read_cloud(path, attributes=False, at_most=AT_MOST, bin_columns=named, bounds=box)

        with ThreadPoolExecutor(2) as pool:
            moving, fixed = pool.map(read, (source, target), boxes)
        with quick_imports():  # after reading: a bad file is said at once
            from fmr_cli.registration import align, export
        found = align(moving, fixed, options, check=bool(metrics or as_json or verbose))
    T, said, warnings = found.T_target_source, export.metrics(moving, fixed, found), [*found.warnings]
    files = [
        io.open_cloud(path, bin_columns=named, bounds=box) for path, box in zip((source, target), boxes, strict=True)
    ]
    if aligned:
        with points_bar("writing the moved source", quiet) as count:
            cloud = export.aligned_cloud(
                files[0], io.open_cloud(target, attributes=False, bin_columns=named, bounds=target_bounds), T
            )
            warnings += io.write_cloud(aligned, count(cloud))
    if merged:
        with points_bar("writing both clouds", quiet) as count:
            cloud, lacking = export.merged_cloud(files[0], files[1], T)
            warnings += lacking + io.write_cloud(merged, count(cloud))
    if metrics:
        outputs.write_json(metrics, said)
    if out:
        io.write_transform(out, T)
    if report:
        with busy("writing the report", quiet):
            from fmr_cli.report.pair_page import write_pair

            write_pair(report, moving, fixed, found, [path for path in (out, aligned, merged, metrics) if path])
    if picture:
        from fmr_cli.report.picture import write_picture

        write_picture(picture, moving, fixed, found)
    if as_json:
        typer.echo(json.dumps(said, indent=2))
    elif not out:
        typer.echo(io.transform_text(T), nl=False)
    say(*export.summary(moving, fixed, found), quiet=quiet)
    warn(*dict.fromkeys(warnings), quiet=quiet)
    if view:
        from fmr_cli.report.view_window import view_pair

        view_pair(files[0], files[1], T)
    if found.status != "aligned":
        raise typer.Exit(UNCERTAIN)
