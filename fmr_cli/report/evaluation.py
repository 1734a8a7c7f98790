"""The experiments' results for people and programs: tables, results.csv, PNG plots."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from rich.table import Table
from torch import Tensor

from fmr_cli.evaluation.experiments import SOLVER, Experiment, Row
from fmr_cli.io.files import atomic_write
from fmr_cli.report import plots
from fmr_cli.report.plots import Series, binomial

SHARES = ("success", "aligned_right", "aligned_wrong")  # measures that are shares of the pairs
EXACT = 1e-4  # degrees, sizes and times the limit: what is below is as good as none, and would squeeze all else
TICKS = (0, 1, 2, 5, 10, 20, 50, 100, 180)  # degrees, on an axis that is linear up to 1 and logarithmic beyond


def table(experiment: Experiment[Any], rows: list[Row]) -> Table:
    """A line for each set, method and level; what is shown follows from what the experiment measures."""
    measured = {name for name, _ in experiment.measures}
    if "aligned_right" in measured:
        return cross_source_table(experiment, rows)
    if "success" in measured:
        return solver_table(experiment, rows)
    return last_step_table(experiment, rows)


def solver_table(experiment: Experiment[Any], rows: list[Row]) -> Table:
    """Success and mean errors."""
    shown = Table("clouds", "method", experiment.axis, "success", "rotation deg", "shift", "RMSE", "s a pair")
    shown.title = f"{experiment.name}: success (below 5 deg), mean (median) errors of {rows[0].pairs} pairs each"
    for r in rows:
        shown.add_row(
            r.clouds, r.method, f"{r.level:g}", f"{r.success:.2f}",
            f"{r.rotation_mean:.2f} ({r.rotation_median:.2f})", f"{r.shift_mean:.3f} ({r.shift_median:.3f})",
            f"{r.rmse_mean:.3f} ({r.rmse_median:.3f})", f"{r.seconds:.3f}",
        )  # fmt: skip
    return shown


def last_step_table(experiment: Experiment[Any], rows: list[Row]) -> Table:
    """Median errors, and where there is noise how many times the limit the rotation's are."""
    limited = any(r.limit_ratio is not None for r in rows)
    shown = Table("clouds", "method", experiment.axis, "rotation deg", "shift / 1000", "s a pair")
    shown.title = f"{experiment.name}: median errors of {rows[0].pairs} pairs each, from near starts"
    if limited:
        shown.add_column("the limit, deg")
        shown.add_column("times the limit")
    for r in rows:
        cells = [
            r.clouds, r.method, f"{r.level:g}", f"{r.rotation_median:.4f}", f"{1000 * r.shift_median:.3f}",
            f"{r.seconds:.3f}",
        ]  # fmt: skip
        if r.limit_ratio is not None:
            cells += [f"{r.limit_median:.4f}", f"{r.limit_ratio:.2f}"]
        shown.add_row(*cells)
    return shown


def cross_source_table(experiment: Experiment[Any], rows: list[Row]) -> Table:
    """Recall, the verdict and the errors."""
    shown = Table(
        "pairs", "method", "strength", "recall", "aligned, right", "aligned, wrong", "scale off", "rotation deg",
        "shift", "s a pair",
    )  # fmt: skip
    shown.title = f"{experiment.name}: shares and median errors of {rows[0].pairs} pairs each"
    for r in rows:
        shown.add_row(
            r.clouds, r.method, f"{r.level:g}", f"{r.success:.2f}", f"{r.aligned_right:.2f}", f"{r.aligned_wrong:.2f}",
            f"{100 * (r.scale_median or 0):.2f} %", f"{r.rotation_median:.2f}", f"{r.shift_median:.4f}",
            f"{r.seconds:.2f}",
        )  # fmt: skip
    return shown


def write_csv(path: Path, rows: list[Row]) -> None:
    """All rows, written as a whole: an interrupted run leaves those of its last complete experiment.

    What an experiment does not measure is an empty cell.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    with atomic_write(path) as temporary:
        temporary.write_text(text.getvalue())


def series(rows: list[Row], measure: str) -> list[Series]:
    """A line for each set and method over the levels; shares with their binomial intervals.

    Without the levels at which it was not measured.
    """
    rows = [r for r in rows if getattr(r, measure) is not None]
    sets = {r.clouds for r in rows}
    found = []
    for clouds, method in dict.fromkeys((r.clouds, r.method) for r in rows):
        own = sorted((r for r in rows if (r.clouds, r.method) == (clouds, method)), key=lambda r: r.level)
        values = [float(getattr(r, measure)) for r in own]
        low = high = None
        if measure in SHARES:
            low, high = zip(*(binomial(getattr(r, measure), r.pairs) for r in own), strict=True)
        name = method if len(sets) == 1 else f"{clouds}, {method}"
        found.append(Series(name, [r.level for r in own], values, low, high))
    return found


def plot(path: Path, experiment: Experiment[Any], rows: list[Row]) -> None:
    """What the experiment measures over its levels."""
    if experiment.measures == SOLVER:
        plot_solver(path, experiment, rows)
        return
    measures = [(name, label) for name, label in experiment.measures if name not in ("shift_median", "aligned_right")]
    with plots.figure(path, plots.PAGE, 2.8) as figure:
        for axes, (name, label) in zip(figure.subplots(1, len(measures), squeeze=False)[0], measures, strict=True):
            axes.set(xlabel=experiment.axis, ylabel=label)
            if name in SHARES:
                axes.set_ylim(-0.03, 1.03)
            elif name != "scale_median":
                axes.set_yscale("log")
            plots.curves(axes, series(rows, name), dodge=0.006)
            if axes.get_yscale() == "log":
                axes.set_ylim(bottom=max(axes.get_ylim()[0], EXACT))


def plot_solver(path: Path, experiment: Experiment[Any], rows: list[Row]) -> None:
    """Success (with 95 % binomial intervals) and median rotation error over the levels."""
    with plots.figure(path, plots.PAGE, 2.8) as figure:
        share, degrees = figure.subplots(1, 2)
        share.set(xlabel=experiment.axis, ylabel="share below 5 deg", ylim=(-0.03, 1.03))
        degrees.set(xlabel=experiment.axis, ylabel="median rotation error, deg")
        degrees.set_yscale("symlog", linthresh=1)
        degrees.set_yticks(TICKS, map(str, TICKS))
        plots.curves(share, series(rows, "success"), dodge=0.006)
        degrees.set_ylim(-0.1, 1.15 * max(1.0, *(r.rotation_median for r in rows)))
        plots.curves(degrees, series(rows, "rotation_median"), dodge=0.006)


def plot_maps(path: Path, maps: dict[int, tuple[Tensor, Tensor]]) -> None:
    """A row an iteration: F of the target, F of the source as moved by then, and their difference."""
    with plots.figure(path, plots.PAGE, 2.3 * len(maps)) as figure:
        draw_maps(figure.subplots(len(maps), 3, squeeze=False), maps)


def draw_maps(axes: Any, maps: dict[int, tuple[Tensor, Tensor]]) -> None:
    """Into panels (iterations, 3)."""
    for row, (iteration, (target, source)) in zip(axes, maps.items(), strict=True):
        low, high = float(target.min()), float(target.max())
        images = (
            ("target", target),
            (f"source, iteration {iteration}", source),
            ("difference", (source - target).abs()),
        )
        for axis, (title, image) in zip(row, images, strict=True):
            least, most = (0.0, high - low) if title == "difference" else (low, high)
            axis.imshow(image.numpy(), vmin=least, vmax=most)
            axis.set(title=title, xticks=[], yticks=[])
            axis.grid(visible=False)
