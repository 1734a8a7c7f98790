"""The `fmr` command: arguments in, one call of the library, a line for a person on stderr, an exit code.

Exit codes: 0 done (every result `aligned`), 2 bad input (one line says what), 3 a result is written but `uncertain`.
Heavy imports stay inside the commands, so that `fmr --help` starts at once.
"""

from __future__ import annotations

import gc
import json
import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from fmr_cli import __version__
from fmr_cli.cli.options import takes_registration_options
from fmr_cli.errors import FmrError

app = typer.Typer(
    help="Feature-metric point cloud registration: two scans in, the right transform out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
err = Console(stderr=True, highlight=False, soft_wrap=True)

BAD_INPUT, UNCERTAIN = 2, 3


@app.callback(invoke_without_command=True)
def root(version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command("align")
@takes_registration_options
def align_command(
    source: Annotated[Path, typer.Argument(help="The cloud that is moved.", show_default=False)],
    target: Annotated[Path, typer.Argument(help="The cloud that it is moved onto.", show_default=False)],
    options: dict[str, Any],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="The 4x4 transform: .txt, .npy or .json. [default: to stdout]")
    ] = None,
    aligned: Annotated[Path | None, typer.Option(help="The moved source, with each point's residual.")] = None,
    merged: Annotated[Path | None, typer.Option(help="Both clouds, with a source_id: 0 source, 1 target.")] = None,
    metrics: Annotated[Path | None, typer.Option(help="Everything said about the result, as .json.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the metrics to stdout, not the matrix.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary.")] = False,
) -> None:
    """Find the transform that moves SOURCE onto TARGET."""
    from fmr_cli import io
    from fmr_cli.io import outputs

    outputs.check_outputs([
        (out, (".txt", ".npy", ".json")), (aligned, io.WRITABLE), (merged, io.WRITABLE), (metrics, (".json",)),
    ])  # fmt: skip
    with busy(f"registering {source.name} onto {target.name}", quiet):
        moving = io.read_cloud(source, attributes=bool(aligned or merged))
        fixed = io.read_cloud(target, attributes=bool(merged))
        with quick_imports():  # after reading: a bad file is said at once
            from fmr_cli.registration import Options, align, export
        found = align(moving, fixed, Options(**options))
    T, said, warnings = found.T_target_source, export.metrics(moving, fixed, found), [*found.warnings]
    if aligned:
        warnings += io.write_cloud(aligned, export.aligned_cloud(moving, fixed, T))
    if merged:
        cloud, lacking = export.merged_cloud(moving, fixed, T)
        warnings += lacking + io.write_cloud(merged, cloud)
    if metrics:
        outputs.write_json(metrics, said)
    if out:
        io.write_transform(out, T)
    if as_json:
        typer.echo(json.dumps(said, indent=2))
    elif not out:
        typer.echo(io.transform_text(T), nl=False)
    if not quiet:
        for line in export.summary(moving, fixed, found):
            say(line)
        for warning in warnings:
            say(f"warning: {warning}")
    if found.status != "aligned":
        raise typer.Exit(UNCERTAIN)


@app.command("batch")
@takes_registration_options
def batch_command(
    manifest: Annotated[
        Path,
        typer.Argument(help="CSV: source, target and optionally init, name; paths relative to it.", show_default=False),
    ],
    options: dict[str, Any],
    out: Annotated[Path, typer.Option(help="The folder for results.csv and transforms/.", show_default=False)],
    aligned: Annotated[bool, typer.Option("--aligned", help="Write each moved source to aligned/.")] = False,
    merged: Annotated[bool, typer.Option("--merged", help="Write both clouds of each pair to merged/.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped run has left off.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Pairs at a time. [default: one a core]", show_default=False)
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Register the pairs of a MANIFEST, each file read once."""
    from collections import Counter

    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    with quick_imports():
        from fmr_cli.batch import align_batch
        from fmr_cli.registration import Options

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, disable=quiet or not err.is_terminal) as progress:
        task = progress.add_task("registering", total=None)

        def on_row(row: dict[str, Any], done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)
            if row["status"] == "failed" and not quiet:
                say(f"{row['source']} onto {row['target']} failed: {row['message']}")

        rows = align_batch(
            manifest, out, Options(**options), aligned=aligned, merged=merged, resume=resume, workers=workers,
            on_row=on_row,
        )  # fmt: skip
    count = Counter(row["status"] for row in rows)
    if not quiet:
        said = ", ".join(f"{count[status]} {status}" for status in ("aligned", "uncertain", "failed"))
        say(f"{said}: {out / 'results.csv'}")
    if count["uncertain"] or count["failed"]:
        raise typer.Exit(UNCERTAIN)


@app.command("sequence")
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
        float | None, typer.Option(help="The map's voxel edge. [default: half the working one]", min=0.0)
    ] = None,
    voxel_size: Annotated[
        float | None, typer.Option(help="The working voxel edge. [default: by the data]", min=0.0)
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
    stop: Annotated[int | None, typer.Option(help="The scan before which to stop. [default: the last]", min=0)] = None,
    step: Annotated[int, typer.Option(help="Take every so many-th scan.", min=1)] = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a stopped run has left off.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Register every scan of a sequence into the frame of the first."""
    from fmr_cli import io
    from fmr_cli.cli.live import live
    from fmr_cli.io import outputs
    from fmr_cli.sequence import SequenceOptions, align_sequence, find_scans

    outputs.check_outputs([(out, (out.suffix.lower(),)), (residuals, (".csv",)), (merged, io.WRITABLE)])
    found = find_scans(scans, start, stop, step, [path for path in (out, residuals, merged) if path])
    for note in [] if quiet else found.notes:
        say(note)
    if truth:
        from fmr_cli.evaluation import trajectory as trajectory_eval

        true = trajectory_eval.read_truth(truth, found.chosen, found.total)
    options = SequenceOptions(
        format=form, camera_frame=camera_frame, voxel_size=voxel_size or None, merged_voxel=merged_voxel or None,
        loop_closure=loop_closure, deskew=deskew,
    )  # fmt: skip
    with live(err, err.is_terminal and not quiet) as show:

        def on_row(row: dict[str, Any], done: int, total: int) -> None:
            show(row, done, total)
            if "message" in row and not quiet:
                say(f"frame {row['frame']} is bridged: {row['message']}")

        result = align_sequence(
            found, out, options, residuals=residuals, merged=merged, resume=resume, on_row=on_row
        )  # fmt: skip
    for line in [] if quiet else result.summary():
        say(line)
    if truth:
        errors = trajectory_eval.evaluate(result.poses, true)
        outputs.write_json(out.with_suffix(".evaluation.json"), errors)
        trajectory_eval.plot(out.with_suffix(".png"), result.poses, true)
        for line in [] if quiet else trajectory_eval.summary(errors):
            say(line)
    if result.status != "aligned":
        raise typer.Exit(UNCERTAIN)


@app.command("info")
def info_command(
    files: Annotated[list[Path], typer.Argument(help="Clouds or meshes.", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON array, one object a file.")] = False,
) -> None:
    """Say what is in each of the FILES."""
    from fmr_cli import io
    from fmr_cli.io.describe import describe, table

    found = []
    for path in files:
        try:
            found.append(describe(io.read_cloud(path)))
        except FmrError as error:
            complain(error)
            continue
        if not as_json:
            typer.echo(table(found[-1]))
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    if len(found) < len(files):
        raise typer.Exit(BAD_INPUT)


@app.command("transform")
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
    for warning in [] if quiet else warnings:
        say(f"warning: {warning}")


@app.command("train")
def train_command(
    scans: Annotated[
        list[Path] | None, typer.Argument(help="Scans, meshes, or folders of them.", show_default=False)
    ] = None,
    unsupervised: Annotated[bool, typer.Option("--unsupervised", help="The Chamfer loss alone; no label.")] = False,
    semi_supervised: Annotated[
        bool, typer.Option("--semi-supervised", help="And the point error of registering moved, cut, noisy copies.")
    ] = False,
    pairs: Annotated[Path | None, typer.Option(help="Labelled pairs, CSV: source, target, transform.")] = None,
    recipe: Annotated[Path | None, typer.Option(help="All settings, .toml; options given here go before it.")] = None,
    start: Annotated[str | None, typer.Option("--from", help="base, scratch, or weights.", show_default="base")] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="The folder of the run.")] = Path("runs/train"),
    minutes: Annotated[float | None, typer.Option(help="Stop after so long.", min=0.0, show_default=False)] = None,
    epochs: Annotated[int | None, typer.Option(help="Stop after so many epochs.", min=1, show_default=False)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out, to the same end.")] = False,
    learning_rate: Annotated[float | None, typer.Option(help="Adam's.", show_default="0.0003", min=0.0)] = None,
    rotation: Annotated[
        float | None, typer.Option(help="Of a moved copy, deg at most.", show_default="45", min=0.0)
    ] = None,
    shift: Annotated[
        float | None, typer.Option(help="Of a moved copy, its size 1.", show_default="0.8", min=0.0)
    ] = None,
    noise: Annotated[
        float | None, typer.Option(help="Largest deviation, size 1.", show_default="0.02", min=0.0)
    ] = None,
    density: Annotated[
        float | None, typer.Option(help="Least share of the points.", show_default="0.1", min=0.01, max=1.0)
    ] = None,
    overlap: Annotated[float | None, typer.Option(help="Least overlap.", show_default="0.6", min=0.1, max=1.0)] = None,
    seed: Annotated[int | None, typer.Option(help="The same seed gives the same weights (CPU).", min=0)] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where to train.")] = "auto",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no table.")] = False,
) -> None:
    """Learn an encoder from SCANS, starting from the bundled one; see what it gained.

    The folder of the run gets model.safetensors (the best epoch's weights, for `fmr align --model`), README.md (what
    they were made from, held-out figures), recipe.toml, metrics.csv and state.safetensors (for --resume).
    """
    from fmr_cli.training.run import settings

    if resume and (unsupervised or semi_supervised or recipe or start or learning_rate is not None or seed is not None):
        raise FmrError("--resume goes on with the settings saved in --out; leave the other settings away")
    chosen = settings(
        recipe, unsupervised=unsupervised, semi_supervised=semi_supervised or pairs is not None, resume=resume,
        minutes=minutes, epochs=epochs, start=start, learning_rate=learning_rate, rotation=rotation, shift=shift,
        noise=noise, density=density, overlap=overlap, seed=seed,
    )  # fmt: skip
    from fmr_cli.report.training import train

    train(scans or [], chosen, out, err, pairs=pairs, minutes=minutes, resume=resume, device=device, quiet=quiet)


@app.command("evaluate")
def evaluate_command(
    scans: Annotated[
        list[Path], typer.Argument(help="Folders of scans or meshes; each is a set of its own.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="For results.csv and plots.")] = Path("evaluation"),
    experiments: Annotated[
        str, typer.Option(help="Comma-separated: rotation, density, noise, overlap, scenes, features.")
    ] = "rotation,density,noise,overlap,scenes,features",
    model: Annotated[
        list[Path] | None,
        typer.Option(help="Weights to evaluate; again for more.", show_default="the bundled ones"),
    ] = None,
    with_baselines: Annotated[
        bool,
        typer.Option("--baselines", help="PointNetLK, LM-ICP, small_gicp; FPFH + RANSAC, KISS-Matcher if installed."),
    ] = False,
    clouds: Annotated[int | None, typer.Option(help="Of each set, at most.", min=1, show_default="all")] = None,
    pairs: Annotated[int, typer.Option(help="Random pairs at each level.", min=1)] = 100,
    points: Annotated[int, typer.Option(help="Of each cloud.", min=16)] = 1024,
    iterations: Annotated[int, typer.Option(help="Of the solver.", min=1)] = 10,
    plain: Annotated[bool, typer.Option("--plain/--no-plain", help="The paper's plain least squares as well.")] = True,
    seed: Annotated[int, typer.Option(help="The same seed gives the same pairs.", min=0)] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where the encoder runs.")] = "auto",
) -> None:
    """The paper's experiments on SCANS: errors by initial rotation, density, noise, overlap, as tables, CSV and plots.

    The solver alone from the identity, without the search over starts and the polish of `fmr align`. Both clouds are
    centred on their means; lengths are in units of the cloud (its largest extent about 1).
    """
    from fmr_cli.cli.evaluate import evaluate

    evaluate(
        scans, out, [name.strip() for name in experiments.split(",")], model or [], with_baselines, clouds, pairs,
        points, iterations, plain, seed, device, Console(highlight=False), say,
    )  # fmt: skip


@contextmanager
def quick_imports() -> Iterator[None]:
    """Imports without garbage collection: what they make stays, and looking through it takes a fifth of their time."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def busy(text: str, quiet: bool) -> AbstractContextManager:
    """A sign of life on a terminal while its block runs."""
    return err.status(text) if err.is_terminal and not quiet else nullcontext()


def say(text: str) -> None:
    """A line for a person, on stderr."""
    err.print(text, markup=False)


def complain(error: Exception) -> None:
    """The one line that says what is wrong, on stderr."""
    err.print(f"fmr: {' '.join(str(error).split())}", style="red", markup=False)


def main() -> None:
    """Run the command; an FmrError or OSError becomes one line on stderr and exit code 2."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's products are small here; its threads only wait
    try:
        app()
    except (FmrError, OSError) as error:
        complain(error)
        sys.exit(BAD_INPUT)


if __name__ == "__main__":
    main()
