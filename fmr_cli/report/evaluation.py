"""The experiments' results for people and programs: tables, results.csv, PNG plots."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from rich.table import Table
from torch import Tensor

from fmr_cli.evaluation.experiments import Experiment, Row
from fmr_cli.io.files import atomic_write
from fmr_cli.report import plots
from fmr_cli.report.plots import Series, binomial

TICKS = (0, 1, 2, 5, 10, 20, 50, 100, 180)  # degrees, on an axis that is linear up to 1 and logarithmic beyond


def table(experiment: Experiment, rows: list[Row]) -> Table:
    """Success and mean errors: a line for each set, method and level."""
    shown = Table("clouds", "method", experiment.axis, "success", "rotation deg", "shift", "RMSE", "s a pair")
    shown.title = f"{experiment.name}: success (below 5 deg), mean (median) errors of {rows[0].pairs} pairs each"
    for r in rows:
        shown.add_row(
            r.clouds, r.method, f"{r.level:g}", f"{r.success:.2f}",
            f"{r.rotation_mean:.2f} ({r.rotation_median:.2f})", f"{r.shift_mean:.3f} ({r.shift_median:.3f})",
            f"{r.rmse_mean:.3f} ({r.rmse_median:.3f})", f"{r.seconds:.3f}",
        )  # fmt: skip
    return shown


def write_csv(path: Path, rows: list[Row]) -> None:
    """All rows, written as a whole: an interrupted run leaves those of its last complete experiment."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    with atomic_write(path) as temporary:
        temporary.write_text(text.getvalue())


def series(rows: list[Row], measure: str) -> list[Series]:
    """A line for each set and method over the levels; shares with their binomial intervals."""
    sets = {r.clouds for r in rows}
    found = []
    for clouds, method in dict.fromkeys((r.clouds, r.method) for r in rows):
        own = sorted((r for r in rows if (r.clouds, r.method) == (clouds, method)), key=lambda r: r.level)
        values = [float(getattr(r, measure)) for r in own]
        low, high = zip(*(binomial(r.success, r.pairs) for r in own), strict=True)
        bounds = (low, high) if measure == "success" else (None, None)
        name = method if len(sets) == 1 else f"{clouds}, {method}"
        found.append(Series(name, [r.level for r in own], values, *bounds))
    return found


def plot(path: Path, experiment: Experiment, rows: list[Row]) -> None:
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
