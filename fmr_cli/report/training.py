"""A training run as a person sees it: a line a step, a line an epoch, a table and the verdict at the end."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from rich.table import Table

from fmr_cli.training.loop import MODEL, Report, Trainer, success_table


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
