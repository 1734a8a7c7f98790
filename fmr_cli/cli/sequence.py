"""`fmr sequence`: many scans in order."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fmr_cli.cli.console import UNCERTAIN, progress, say, show_log
from fmr_cli.cli.options import Quiet, Verbose

if TYPE_CHECKING:
    import numpy as np

    from fmr_cli.sequence.run import Sequence

NAMED = 20  # uncertain frames that are named at the end, at most


def sequence_command(
    scans: Annotated[
        Path,
        typer.Argument(help="A folder of scans, a KITTI sequence or drive, or a list (.txt).", show_default=False),
    ],
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
        float | None, typer.Option(help="The working voxel edge; from the data if not given.", min=0.0)
    ] = None,
    loop_closure: Annotated[
        bool, typer.Option("--loop-closure", help="Close loops in --out; the path before goes to NAME.odometry.*.")
    ] = False,
    deskew: Annotated[
        bool, typer.Option("--deskew", help="Undo the motion within each scan, by the times of its points.")
    ] = False,
    truth: Annotated[
        Path | None, typer.Option(help="True poses, KITTI rows: errors beside --out as .evaluation.json and .png.")
    ] = None,
    start: Annotated[int, typer.Option(help="The first scan, counted from 0.", min=0)] = 0,
    stop: Annotated[int | None, typer.Option(help="The scan before which to stop; none if not given.", min=0)] = None,
    step: Annotated[int, typer.Option(help="Take every so many-th scan.", min=1)] = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped run has left off.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Register every scan of a sequence into the frame of the first."""
    from fmr_cli import io
    from fmr_cli.io import outputs
    from fmr_cli.sequence.run import Sequence
    from fmr_cli.sequence.scans import find_scans

    show_log(verbose)
    outputs.check_outputs([(out, (out.suffix.lower(),)), (residuals, (".csv",)), (merged, io.WRITABLE)])
    found = find_scans(scans, start, stop, step, [path for path in (out, residuals, merged) if path])
    say(*found.notes, quiet=quiet)
    true = read_truth(truth, found) if truth else None
    sequence = Sequence(
        found, out, form=form, camera_frame=camera_frame, residuals=residuals, merged=merged,
        merged_voxel=merged_voxel or None, voxel_size=voxel_size or None, loop_closure=loop_closure,
        deskew=deskew,
    )  # fmt: skip
    follow(sequence, resume, quiet)
    say(*sequence.summary(), quiet=quiet)
    if true is not None:
        compare(sequence.trajectory(), true, out, quiet)
    if sequence.uncertain:
        say(look_at(sequence.uncertain), quiet=quiet)
        raise typer.Exit(UNCERTAIN)


def read_truth(path: Path, found: Any) -> np.ndarray:
    """(n, 4, 4): the true poses of the chosen scans. Raises FmrError before anything is registered."""
    from fmr_cli.evaluation import trajectory

    return trajectory.read_truth(path, found.chosen, found.total)


def follow(sequence: Sequence, resume: bool, quiet: bool) -> None:
    """The run from its first frame, or where an earlier one has left off, to the last."""
    done = sequence.open(resume)
    begin, length = time.perf_counter(), 0.0
    with progress(quiet) as bar:
        task = bar.add_task("registering", total=len(sequence.scans.files), completed=done, said="")
        for row in sequence.run():
            length += row["motion"]
            rate = (row["frame"] + 1 - done) / (time.perf_counter() - begin)
            bar.update(task, advance=1, said=f"{rate:.1f} frames/s, {row['status']}, path {length:.4g}")
            if "message" in row:
                say(f"frame {row['frame']} is bridged: {row['message']}", quiet=quiet)


def compare(poses: np.ndarray, true: np.ndarray, out: Path, quiet: bool) -> None:
    """Errors against the truth, and a plot, beside ``out``."""
    from fmr_cli.evaluation import trajectory
    from fmr_cli.io import outputs

    errors = trajectory.evaluate(poses, true)
    outputs.write_json(out.with_suffix(".evaluation.json"), errors)
    trajectory.plot(out.with_suffix(".png"), poses, true)
    say(*trajectory.summary(errors), quiet=quiet)


def look_at(uncertain: list[dict[str, Any]]) -> str:
    """Which frames a person should look at."""
    names = ", ".join(f"{row['frame']} ({row['file']})" for row in uncertain[:NAMED])
    more = len(uncertain) - NAMED
    return f"{len(uncertain)} uncertain, look at: {names}{f' and {more} more' if more > 0 else ''}"
