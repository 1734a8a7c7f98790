"""`fmr train`: an encoder from scans, interrupted and resumed at will."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fmr_cli.cli.console import err, progress, say, warn
from fmr_cli.cli.options import Report, Topic, check_report
from fmr_cli.errors import FmrError

if TYPE_CHECKING:
    from fmr_cli.training.loop import Trainer


def train_command(
    scans: Annotated[
        list[Path] | None, typer.Argument(help="Scans, meshes, bags, or folders of scans.", show_default=False)
    ] = None,
    unsupervised: Annotated[bool, typer.Option("--unsupervised", help="From the scans alone; no label.")] = False,
    semi_supervised: Annotated[
        bool,
        typer.Option(
            "--semi-supervised", help="And, for the global encoder, the error of registering moved, cut, noisy copies."
        ),
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
    report: Report = None,
    topic: Topic = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no table.")] = False,
) -> None:
    """Learn from SCANS what registration uses, starting from the bundled model; see what it gained.

    The scans are registered with each other, in rounds; where two show one place the local features learn to match,
    and the encoder of whole clouds goes on as well. What they show of a site is kept too, for scans of it that hardly
    overlap. At the end, held-out pairs are registered before and after, and what has got worse is not kept. A recipe
    may be of another kind: "global", or "local" on made-up scans alone.
    The folder of the run gets model.safetensors (for `--model` of align, batch, sequence, multiway), README.md (what
    it was made from, held-out figures), training.png, recipe.toml, metrics.csv, registered.json (the poses found) and
    state.safetensors (for --resume).
    """
    from fmr_cli.io.parts import with_topic
    from fmr_cli.training.run import prepare, settings

    check_report(report)
    scans = [with_topic(path, topic) for path in scans or []] or None

    if resume and (unsupervised or semi_supervised or recipe or start or learning_rate is not None or seed is not None):
        raise FmrError("--resume goes on with the settings saved in --out; leave the other settings away")
    chosen = settings(
        recipe, unsupervised=unsupervised, semi_supervised=semi_supervised or pairs is not None, resume=resume,
        minutes=minutes, epochs=epochs, start=start, learning_rate=learning_rate, rotation=rotation, shift=shift,
        noise=noise, density=density, overlap=overlap, seed=seed,
    )  # fmt: skip
    with progress(quiet, counted=False) as bar:
        task = bar.add_task("reading", total=None, said="")

        def reading(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, said=f"{done} of {total} scans")

        trainer, warnings = prepare(
            scans or [], chosen, out, pairs=pairs, minutes=minutes, resume=resume, device=device, progress=reading
        )
        quiet = quiet or trainer.rank > 0  # of several processes, one speaks
        warn(*warnings, quiet=quiet)
        say(f"learning from {'; '.join(trainer.task.described)}", quiet=quiet)
        bar.update(task, description="testing", total=None, said="what is held out, before training")
        trainer.show = lambda what, done, total: bar.update(
            task, description=what, completed=done, total=total, said=""
        )
        stopped = learn(trainer, partial(bar.update, task), quiet)
    if report and trainer.rank == 0 and trainer.progress.scores:
        from fmr_cli.report.training_page import write_training

        write_training(report, trainer, stopped)
    if not quiet:
        conclude(trainer, stopped)


def learn(trainer: Trainer, show: Callable[..., None], quiet: bool) -> bool:
    """Train to the end, or to Ctrl-C, and write the card; whether it was stopped. ``show`` updates the bar."""
    from fmr_cli.report.training import epoch_line, line, tensorboard
    from fmr_cli.training.run import write_card

    board = tensorboard(trainer.folder.path) if trainer.rank == 0 else None
    try:
        for report in trainer.run():
            show(description="training", completed=report.step, total=report.steps, said=line(report))
            say(*report.notes, quiet=quiet)
            if report.row:
                say(epoch_line(report.row), quiet=quiet)
            if report.row and board is not None:
                for name, value in report.row.items():
                    board.add_scalar(name, value, report.step)
    except KeyboardInterrupt:
        return True
    finally:
        if board is not None:
            board.close()
        if trainer.rank == 0 and trainer.progress.scores:
            write_card(trainer)
    return False


def conclude(trainer: Trainer, stopped: bool) -> None:
    """What was gained, as a table and in words."""
    from fmr_cli.report.training import check_report, plot, table, verdict

    if not trainer.progress.scores:
        say("stopped before the first test: nothing was written")
        return
    err.print(table(trainer))
    if (checked := check_report(trainer)) is not None:
        err.print(checked)
    if missing := plot(trainer):
        say(missing)
    say(verdict(trainer, stopped))
