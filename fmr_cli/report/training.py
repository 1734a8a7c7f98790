"""A training run as a person sees it: a line a step, a line an epoch, a table and the verdict at the end."""

from __future__ import annotations

import contextlib
import csv
from pathlib import Path
from typing import Any

from rich.table import Table

from fmr_cli.io.files import atomic_write
from fmr_cli.training.loop import Report, Trainer
from fmr_cli.training.run import check_cells, score_table
from fmr_cli.training.run_folder import METRICS, MODEL

PLOT = "training.png"


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


def check_report(trainer: Trainer) -> Table | None:
    """Held-out pairs through ``align``, before and after; None where none were registered."""
    check = trainer.progress.check
    if not check or not check["rows"]:
        return None
    columns = ("pairs of", "overlap", "pairs", "right", "aligned", "wrong, yet aligned", "right matches", "error, deg")
    shown = Table(*columns, title="held-out pairs through align, before to after")
    for cells in check_cells(check):
        shown.add_row(*cells)
    return shown


def plot(trainer: Trainer) -> str:
    """``training.png``: losses, held-out figures by step, pairs before and after. Returns why there is none, or ''."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return f"no {PLOT}: it needs matplotlib; pip install 'fmr-cli[eval]'"
    path = trainer.folder.path
    table = list(csv.DictReader((path / METRICS).open(newline="")))
    steps = [int(row["step"]) for row in table]
    check = (trainer.progress.check or {}).get("rows", [])
    figure = Figure((13 if check else 9, 3.6), layout="constrained")
    axes = figure.subplots(1, 3 if check else 2)
    for name in [n for n in table[0] if n.startswith("loss_")] or [n for n in table[-1] if n.startswith("loss_")]:
        known = [(s, float(row[name])) for s, row in zip(steps, table, strict=True) if row[name]]
        axes[0].plot(*zip(*known, strict=True), ".-", label=name[5:])
    shares = [n for n in table[0] if n.endswith((": right matches", ": rank-1", ": success"))]
    for name in shares:
        axes[1].plot(steps, [float(row[name]) for row in table], ".-", label=name.split(":")[0])
    axes[0].set(xlabel="step", title="losses", yscale="log")
    axes[1].set(xlabel="step", title=trainer.task.measure)
    axes[1].set_ylim(bottom=0)
    if check:
        width, place = 0.2, range(len(check))
        for k, (what, when) in enumerate((w, t) for w in ("right", "aligned") for t in ("before", "after")):
            values = [row[when][what] / row["pairs"] for row in check]
            axes[2].bar([p + (k - 1.5) * width for p in place], values, width, label=f"{what} {when}",
                        color=("0.8", "tab:blue", "0.6", "tab:green")[k])  # fmt: skip
        axes[2].set_xticks(list(place), [f"{r['kind']}\n{r['overlap']} ({r['pairs']})" for r in check], fontsize=6)
        axes[2].set(title="held-out pairs through align", ylim=(0, 1.05))
    for a in axes:
        a.legend(fontsize=6) if a.get_legend_handles_labels()[0] else None
    with atomic_write(path / PLOT) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
    return ""


def verdict(trainer: Trainer, stopped: bool) -> str:
    """What was gained, and where it lies."""
    progress, task = trainer.progress, trainer.task
    how = f"stopped at step {progress.step}: " if stopped else ""
    where = f"{trainer.folder.path / MODEL}"
    if progress.check and not progress.check["kept"]:
        return f"{how}{progress.check['said'][0]}"
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
