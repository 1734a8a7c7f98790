"""`fmr batch`: many pairs from a manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fmr_cli.cli.console import STOPPED, UNCERTAIN, busy, progress, quick_imports, say, show_log
from fmr_cli.cli.options import Dask, Quiet, Report, Verbose, check_report, chosen_workers, takes_registration_options
from fmr_cli.registration.options import Options


@takes_registration_options
def batch_command(
    manifest: Annotated[
        Path,
        typer.Argument(help="CSV: source, target and optionally init, name; paths relative to it.", show_default=False),
    ],
    options: Options,
    out: Annotated[
        Path, typer.Option(help="The folder for results.csv, transforms/ and metrics/.", show_default=False)
    ],
    aligned: Annotated[bool, typer.Option("--aligned", help="Write each moved source to aligned/.")] = False,
    merged: Annotated[bool, typer.Option("--merged", help="Write both clouds of each pair to merged/.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped run has left off.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Pairs at a time; one a core if not given.", show_default=False)
    ] = None,
    dask: Dask = None,
    report: Report = None,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Register the pairs of a MANIFEST, each file read once."""
    from collections import Counter

    show_log(verbose)
    check_report(report)
    with quick_imports():
        from fmr_cli.batch import align_batch

    with chosen_workers(workers, dask, quiet) as team, progress(quiet) as bar:
        task = bar.add_task("registering", total=None, said="")

        def on_row(row: dict[str, Any], done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)
            if row["status"] == "failed":
                say(f"{row['source']} onto {row['target']} failed: {row['message']}", quiet=quiet)

        try:
            rows = align_batch(
                manifest, out, options, aligned=aligned, merged=merged, resume=resume, workers=team, on_row=on_row
            )
        except KeyboardInterrupt:
            say(f"stopped; what is done is kept in {out}, --resume goes on", quiet=quiet)
            raise typer.Exit(STOPPED) from None
    if report:
        with busy("writing the report", quiet):
            from fmr_cli.report.batch_page import write_batch

            write_batch(report, manifest.parent, out, rows)
    count = Counter(row["status"] for row in rows)
    said = ", ".join(f"{count[status]} {status}" for status in ("aligned", "uncertain", "failed"))
    say(f"{said}: {out / 'results.csv'}", quiet=quiet)
    if count["uncertain"] + count["failed"]:
        raise typer.Exit(UNCERTAIN)
