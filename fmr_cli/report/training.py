"""A training run as a person sees it: a line a step, a line an epoch, a table and the verdict at the end."""

from __future__ import annotations

import contextlib
import csv
from pathlib import Path
from typing import Any

from rich.table import Table

from fmr_cli.report import plots
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
    if not plots.can_plot():
        return f"no {PLOT}: it needs matplotlib; pip install 'fmr-cli[report]'"
    path = trainer.folder.path
    table = list(csv.DictReader((path / METRICS).open(newline="")))
    steps = [int(row["step"]) for row in table]
    check = (trainer.progress.check or {}).get("rows", [])
    with plots.figure(path / PLOT, plots.PAGE, 2.8) as figure:
        panels = figure.subplots(1, 3 if check else 2)
        panels[0].set(xlabel="step", title="losses", yscale="log")
        panels[1].set(xlabel="step", title=trainer.task.measure, ylim=(-0.03, 1.03))
        names = [n for n in table[0] if n.startswith("loss_")] or [n for n in table[-1] if n.startswith("loss_")]
        plots.curves(panels[0], [column(table, steps, name, name[5:]) for name in names])
        shares = [n for n in table[0] if n.endswith((": right matches", ": rank-1", ": success"))]
        plots.curves(panels[1], [column(table, steps, name, name.split(":")[0]) for name in shares])
        if check:
            draw_check(panels[2], check)
            panels[2].set(title="held-out pairs, before to after", xlim=(-0.02, 1.05))
    return ""


def column(table: list[dict[str, str]], steps: list[int], name: str, label: str) -> plots.Series:
    """A column of metrics.csv as a line, where it has values."""
    known = [(step, float(row[name])) for step, row in zip(steps, table, strict=True) if row[name]]
    return plots.Series(label, [x for x, _ in known], [y for _, y in known])


def draw_check(panel: Any, check: list[dict[str, Any]]) -> None:
    """Shares of held-out pairs that align gets right, and calls aligned: an arrow each from before to after."""
    for place, row in enumerate(check):
        for number, what in enumerate(("right", "aligned")):
            before, after = (row[when][what] / row["pairs"] for when in ("before", "after"))
            at, color = place + 0.3 * (number - 0.5), plots.COLORS[number]
            panel.plot([before, after], [at, at], color=color)
            panel.plot(before, at, "o", color=color, markerfacecolor="white")
            panel.plot(after, at, "o", color=color)
            if place == 0:
                panel.annotate(what, (max(before, after), at), (5, 0), textcoords="offset points", va="center",
                               color=color, fontsize=7)  # fmt: skip
    panel.set_yticks(range(len(check)), [f"{r['kind']}\n{r['overlap']} ({r['pairs']})" for r in check], fontsize=6)
    panel.invert_yaxis()
    panel.set_xlabel("share of the pairs")


def verdict(trainer: Trainer, stopped: bool) -> str:
    """What was gained, and where it lies."""
    progress, task = trainer.progress, trainer.task
    how = f"stopped at step {progress.step}: " if stopped else ""
    where = f"{trainer.folder.path / MODEL}"
    check = progress.check or {"kept": True, "rows": [], "said": []}
    if not check["kept"]:
        return f"{how}{check['said'][-1]}"
    if check["rows"]:
        counts = ([row[when] for row in check["rows"]] for when in ("before", "after"))
        before, after = (sum(row["aligned"] - row["wrong"] for row in rows) for rows in counts)
        pairs = sum(row["pairs"] for row in check["rows"])
        how += f"of {pairs} held-out pairs {before} were right and aligned, {after} are; "
    if progress.best == 0:
        return f"{how}training made the encoders no better; {where} holds the start's"
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
