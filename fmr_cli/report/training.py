"""`fmr train` as a person sees it: one live line, a table that grows by an epoch, and the verdict."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from fmr_cli.registration.models import Device
from fmr_cli.training.loop import MODEL, Report, Trainer, success_table
from fmr_cli.training.recipe import Recipe
from fmr_cli.training.run import prepare, write_card


def train(
    scans: list[Path],
    recipe: Recipe,
    out: Path,
    console: Console,
    *,
    pairs: Path | None,
    minutes: float | None,
    resume: bool,
    device: Device,
    quiet: bool,
) -> None:
    """Runs to the end, to the minutes' end or to Ctrl-C, and says what came of it. Raises FmrError."""
    live = not quiet and console.is_terminal
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[said]}"))
    with Progress(*columns, console=console, disable=not live) as bar:
        task = bar.add_task("reading", total=None, said="")

        def reading(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, said=f"{done} of {total} scans")

        trainer, warnings = prepare(
            scans, recipe, out, pairs=pairs, minutes=minutes, resume=resume, device=device, progress=reading
        )
        quiet = quiet or trainer.rank > 0
        if not quiet:
            for warning in warnings:
                console.print(f"warning: {warning}", markup=False)
            console.print(f"learning from {'; '.join(trainer.data.described)}", markup=False)
        board = tensorboard(out) if trainer.rank == 0 else None
        stopped = False
        try:
            bar.update(task, description="registering", total=None, said="the held-out clouds, before training")
            for report in trainer.run():
                bar.update(task, description="training", completed=report.step, total=report.steps, said=line(report))
                if report.row and not quiet:
                    console.print(epoch_line(report.row), markup=False)
                if report.row and board is not None:
                    for name, value in report.row.items():
                        board.add_scalar(name, value, report.step)
        except KeyboardInterrupt:
            stopped = True
        finally:
            if board is not None:
                board.close()
            if trainer.rank == 0 and trainer.progress.scores:
                write_card(trainer)
    if quiet:
        return
    if not trainer.progress.scores:
        console.print("stopped before the first test: nothing was written")
        return
    console.print(table(trainer))
    console.print(verdict(trainer, stopped), markup=False)


def line(report: Report) -> str:
    minutes, seconds = divmod(int(report.left), 60)
    return f"loss {report.loss:.4f}, {report.samples_per_second:.0f} clouds/s, {minutes}:{seconds:02} left"


def epoch_line(row: dict[str, Any]) -> str:
    losses = ", ".join(f"{name[5:]} {value:.5f}" for name, value in row.items() if name.startswith("loss_"))
    errors = [value for name, value in row.items() if name.endswith("median deg")]
    return (
        f"epoch {row['epoch']}, step {row['step']}: {losses or 'the start'}; held out: success {row['success']:.3f}, "
        f"median error {sum(errors) / len(errors):.2f} deg"
    )


def table(trainer: Trainer) -> Table:
    """Held-out success and median error at every setting, at the start and of what is kept."""
    shown = Table(
        "held out", "start", "kept", title=f"{trainer.recipe.held_out_pairs} registrations each: below 5 deg (median)"
    )
    for name, before, after in success_table(trainer):
        shown.add_row(name, *(f"{success:.2f} ({median:.2f} deg)" for success, median in (before, after)))
    return shown


def verdict(trainer: Trainer, stopped: bool) -> str:
    """What was gained, and where it lies."""
    progress = trainer.progress
    how = f"stopped at step {progress.step}: " if stopped else ""
    where = f"{trainer.out / MODEL}"
    if progress.best == 0:
        return f"{how}training made it no better than its start; {where} holds the start"
    (before, off), (after, now) = trainer.quality(0), trainer.quality(progress.best)
    return (
        f"{how}held-out success {before:.3f} at the start, {after:.3f} at epoch {progress.best}, which is kept "
        f"(mean error, at most 30 each: {-off:.2f} deg before, {-now:.2f} now): {where}"
    )


def tensorboard(out: Path) -> Any:
    """A writer for TensorBoard where it is installed, else None."""
    with contextlib.suppress(ImportError):
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(out))
    return None
