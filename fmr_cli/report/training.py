"""A training run as a person sees it: a line a step, a line an epoch, a table and the verdict at the end."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from rich.table import Table

from fmr_cli.training.loop import Report, Trainer
from fmr_cli.training.run import score_table
from fmr_cli.training.run_folder import MODEL


def line(report: Report) -> str:
    """What the live line says."""
    minutes, seconds = divmod(int(report.left), 60)
    return f"loss {report.loss:.4f}, {report.clouds_per_second:.0f} clouds/s, {minutes}:{seconds:02} left"


def epoch_line(row: dict[str, Any]) -> str:
    """What an epoch has to say, from its row of metrics.csv."""
    losses = ", ".join(f"{name[5:]} {value:.5f}" for name, value in row.items() if name.startswith("loss_"))
    errors = [value for name, value in row.items() if name.endswith("median deg")]
    median = f", median error {sum(errors) / len(errors):.2f} deg" if errors else ""
    return f"epoch {row['epoch']}, step {row['step']}: {losses or 'the start'}; held out: {row['success']:.3f}{median}"


def table(trainer: Trainer) -> Table:
    """Held-out scores at every setting, at the start and of what is kept."""
    shown = Table("held out", "start", "kept", title=trainer.task.measured)
    for row in score_table(trainer):
        shown.add_row(*row)
    return shown


def verdict(trainer: Trainer, stopped: bool) -> str:
    """What was gained, and where it lies."""
    progress, task = trainer.progress, trainer.task
    how = f"stopped at step {progress.step}: " if stopped else ""
    where = f"{trainer.folder.path / MODEL}"
    if progress.best == 0:
        return f"{how}training made it no better than its start; {where} holds the start"
    before, after = trainer.quality(0)[0], trainer.quality(progress.best)[0]
    more = task.gain(progress.scores["0"], progress.scores[str(progress.best)])
    return (
        f"{how}{task.measure} {before:.3f} at the start, {after:.3f} at epoch {progress.best}, which is kept"
        f"{f' ({more})' if more else ''}: {where}"
    )


def tensorboard(out: Path) -> Any:
    """A writer for TensorBoard where it is installed, else None."""
    with contextlib.suppress(ImportError):
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(out))
    return None
