"""`fmr multiway`: many scans in any order."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from fmr_cli.cli.console import STOPPED, UNCERTAIN, busy, progress, quick_imports, say, show_log, warn
from fmr_cli.cli.options import Dask, Quiet, Report, Verbose, check_report, chosen_workers, takes_registration_options
from fmr_cli.registration.options import Options

TAKEN = ("voxel_size", "dof", "up", "max_angle", "max_shift", "model", "device", "seed")  # options of a pair


@partial(takes_registration_options, names=TAKEN)
def multiway_command(
    scans: Annotated[
        list[Path],
        typer.Argument(help="Scans, folders of them, text files that list them; any order.", show_default=False),
    ],
    options: Options,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="The folder for scans.csv, links.csv, poses/, network.json.")
    ],
    links: Annotated[
        Path | None,
        typer.Option(help="CSV: source, target and optionally transform, use (known, try, never).", show_default=False),
    ] = None,
    init_poses: Annotated[
        Path | None,
        typer.Option(
            help="CSV: scan, pose (a file or 12 numbers) and optionally sigma_rot_deg, sigma_shift.", show_default=False
        ),
    ] = None,
    fixed: Annotated[
        list[str] | None, typer.Option(help="A scan that doesn't move; again for more.", show_default=False)
    ] = None,
    anchor: Annotated[
        str | None, typer.Option(help="The scan whose frame is the common one; the best connected if not given.")
    ] = None,
    merged: Annotated[
        Path | None, typer.Option(help="All placed scans in one cloud, with a scan_id; one a component.")
    ] = None,
    merged_voxel: Annotated[float | None, typer.Option(help="Thin --merged to a point a voxel.", min=0.0)] = None,
    aligned: Annotated[bool, typer.Option("--aligned", help="Write each moved scan to aligned/.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped run has left off.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Pairs at a time; one a core if not given.", show_default=False)
    ] = None,
    dask: Dask = None,
    report: Report = None,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Find a common frame for many SCANS: a pose for each, a table of links, a word on both."""
    show_log(verbose)
    check_report(report)
    with quick_imports():
        from fmr_cli.io import WRITABLE
        from fmr_cli.io.outputs import check_outputs
        from fmr_cli.multiway import export
        from fmr_cli.multiway.known import Known, read_init_poses, read_links
        from fmr_cli.multiway.pipeline import align_many
        from fmr_cli.multiway.survey import Progress

    check_outputs([(merged, WRITABLE)])
    known = Known(
        read_links(links) if links else (),
        read_init_poses(init_poses) if init_poses else {},
        tuple(fixed or ()),
        anchor,
    )
    with chosen_workers(workers, dask, quiet) as team, progress(quiet) as bar:
        task = bar.add_task("reading", total=None, said="")

        def show(now: Progress) -> None:
            said = f"{now.aligned} links aligned, {now.components} components" if now.components else ""
            bar.update(task, description=now.stage, completed=now.done, total=now.total, said=said)

        try:
            network = align_many(scans, options, known=known, out=out, resume=resume, workers=team, progress=show)
        except KeyboardInterrupt:
            say(f"stopped; what is done is kept in {out}, --resume goes on", quiet=quiet)
            raise typer.Exit(STOPPED) from None
        bar.update(task, description="writing", said="")
        export.write_network(network, out)
        warnings = export.write_aligned(network, out) if aligned else []
        warnings += export.write_merged(network, merged, merged_voxel or None) if merged else []
    if report:
        with busy("writing the report", quiet):
            from fmr_cli.report.multiway_page import write_multiway

            write_multiway(report, network, export.summary(network))
    say(*export.summary(network), quiet=quiet)
    warn(*dict.fromkeys(warnings), quiet=quiet)
    say(f"{out / 'scans.csv'}, {out / 'links.csv'}", quiet=quiet)
    if not network.whole:
        raise typer.Exit(UNCERTAIN)
