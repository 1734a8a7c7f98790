"""`fmr sequence`: many scans in order."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fmr_cli.cli.console import UNCERTAIN, busy, progress, say, show_log
from fmr_cli.cli.options import (
    PICTURES,
    Quiet,
    Report,
    Topic,
    Verbose,
    check_picture,
    check_report,
    takes_registration_options,
)
from fmr_cli.registration.options import Options

if TYPE_CHECKING:
    import numpy as np
    from rich.progress import Progress

    from fmr_cli.evaluation.truth import Truth
    from fmr_cli.sequence.scans import Scans


@partial(takes_registration_options, names=("model",))
def sequence_command(
    scans: Annotated[
        Path,
        typer.Argument(
            help="A folder of scans, a KITTI sequence or drive, a bag, or a list (.txt).", show_default=False
        ),
    ],
    options: Options,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="The poses, each frame to the first, in the sensor's frame.")
    ],
    form: Annotated[Literal["kitti", "tum", "json"], typer.Option("--format", help="Of the poses.")] = "kitti",
    camera_frame: Annotated[
        bool, typer.Option("--camera-frame", help="Poses of the camera, by calib.txt, as KITTI's own truth.")
    ] = False,
    residuals: Annotated[Path | None, typer.Option(help="A CSV row a frame: status, residuals, seconds.")] = None,
    merged: Annotated[Path | None, typer.Option(help="The map: a point a voxel, its attributes and frame.")] = None,
    merged_voxel: Annotated[
        float | None, typer.Option(help="The map's voxel edge; half the working one if not given.", min=0.0)
    ] = None,
    voxel_size: Annotated[
        float | None, typer.Option(help="A wish for the working voxel edge, which the scans' density bounds.", min=0.0)
    ] = None,
    init_poses: Annotated[
        Path | None,
        typer.Option(help="Poses known beforehand, by odometry or GNSS: CSV of scan,pose[,sigma_rot_deg,sigma_shift]."),
    ] = None,
    known_map: Annotated[
        Path | None, typer.Option("--map", help="A known map: poses are those in it, the first scan is found in it.")
    ] = None,
    loop_closure: Annotated[
        bool, typer.Option("--loop-closure", help="Close loops in --out; the path before goes to NAME.odometry.*.")
    ] = False,
    deskew: Annotated[
        bool | None,
        typer.Option(
            "--deskew/--no-deskew",
            help="Undo the motion within scans, by points' times or azimuth; by default if they tell.",
        ),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="True poses (KITTI, TUM, .npy): errors, and a picture, beside --out.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Path over the map, height, sigmas, status, errors: .png, .pdf, .svg.")
    ] = None,
    start: Annotated[int, typer.Option(help="The first scan, counted from 0.", min=0)] = 0,
    stop: Annotated[int | None, typer.Option(help="The scan before which to stop; none if not given.", min=0)] = None,
    step: Annotated[int, typer.Option(help="Take every so many-th scan.", min=1)] = 1,
    report: Report = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped run has left off.")] = False,
    topic: Topic = None,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Register every scan of a sequence into the frame of the first."""
    from fmr_cli import io
    from fmr_cli.io import outputs
    from fmr_cli.io.parts import with_topic
    from fmr_cli.multiway.known import read_init_poses
    from fmr_cli.sequence import SequenceOptions, align_sequence, find_scans

    show_log(verbose)
    check_report(report)
    check_picture(picture)
    outputs.check_outputs([
        (out, (out.suffix.lower(),)), (residuals, (".csv",)), (merged, io.WRITABLE), (picture, PICTURES),
    ])  # fmt: skip
    found = find_scans(with_topic(scans, topic), start, stop, step, [path for path in (out, residuals, merged) if path])
    say(*found.notes, quiet=quiet)
    true = read_truth(truth, found, quiet) if truth else None
    chosen = SequenceOptions(
        format=form, camera_frame=camera_frame, voxel_size=voxel_size or None, merged_voxel=merged_voxel or None,
        loop_closure=loop_closure, deskew=deskew, model=options.model,
    )  # fmt: skip
    told = read_init_poses(init_poses) if init_poses else None
    with progress(quiet) as bar:
        result = align_sequence(
            found, out, chosen, init_poses=told, known_map=known_map, residuals=residuals, merged=merged,
            resume=resume, on_row=follow(bar, quiet),
        )  # fmt: skip
    if report:
        with busy("writing the report", quiet):
            from fmr_cli.report.sequence_page import write_sequence

            write_sequence(report, result, found, chosen)
    say(*result.summary(), quiet=quiet)
    if true:
        compare(result.poses, true, out, quiet)
    if picture or true:
        with busy("drawing the picture", quiet):
            from fmr_cli.report.sequence_picture import write_picture

            write_picture(picture or out.with_suffix(".png"), result, found, chosen, true)
    if result.status != "aligned":
        raise typer.Exit(UNCERTAIN)


def read_truth(path: Path, found: Scans, quiet: bool) -> Truth:
    """The true poses of the chosen scans. Raises FmrError before anything is registered."""
    from fmr_cli.evaluation import truth

    true = truth.read_truth(path, found.chosen, found.total, found.times)
    if true.note:
        say(true.note, quiet=quiet)
    return true


def follow(bar: Progress, quiet: bool) -> Callable[[dict[str, Any], int, int], None]:
    """The function that takes each new row, how many rows there are, and of how many: it moves the bar on."""
    begin, length, seen = time.perf_counter(), 0.0, 0
    task = bar.add_task("registering", total=None, said="")

    def on_row(row: dict[str, Any], done: int, total: int) -> None:
        nonlocal length, seen
        length, seen = length + row["motion"], seen + 1
        rate = seen / (time.perf_counter() - begin)
        said = f"{rate:.1f} frames/s, {row['status']}, path {length:.4g}"
        bar.update(task, total=total, completed=done, said=said)
        if "message" in row:
            say(f"frame {row['frame']} is bridged: {row['message']}", quiet=quiet)

    return on_row


def compare(poses: np.ndarray, true: Truth, out: Path, quiet: bool) -> None:
    """Errors against the truth, said and written beside ``out``."""
    from fmr_cli.evaluation import trajectory
    from fmr_cli.io import outputs

    errors = trajectory.evaluate(true.beside(poses), true.poses)
    outputs.write_json(out.with_suffix(".evaluation.json"), errors)
    say(*trajectory.summary(errors), quiet=quiet)
