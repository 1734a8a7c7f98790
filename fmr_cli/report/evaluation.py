"""The experiments' results for people and programs: tables, results.csv, PNG plots."""

from __future__ import annotations

import csv
import importlib.util
import io
from dataclasses import asdict, fields
from pathlib import Path

from rich.table import Table
from torch import Tensor

from fmr_cli.evaluation.experiments import Experiment, Row
from fmr_cli.io.files import atomic_write


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


def can_plot() -> bool:
    return importlib.util.find_spec("matplotlib") is not None


def plot(path: Path, experiment: Experiment, rows: list[Row]) -> None:
    """Success and mean rotation error over the levels, a line for each set and method."""
    from matplotlib.figure import Figure

    figure = Figure((10, 4), layout="constrained")
    share, degrees = figure.subplots(1, 2)
    for clouds, method in dict.fromkeys((r.clouds, r.method) for r in rows):
        own = [r for r in rows if (r.clouds, r.method) == (clouds, method)]
        levels = [r.level for r in own]
        share.plot(levels, [r.success for r in own], "o-", label=f"{clouds}, {method}")
        degrees.plot(levels, [r.rotation_mean for r in own], "o-")
    share.set(xlabel=experiment.axis, ylabel="share below 5 deg", ylim=(-0.02, 1.02))
    degrees.set(xlabel=experiment.axis, ylabel="mean rotation error, deg")
    share.legend(fontsize="small")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)


def plot_maps(path: Path, maps: dict[int, tuple[Tensor, Tensor]]) -> None:
    """A row an iteration: F of the target, F of the source as moved by then, and their difference."""
    from matplotlib.figure import Figure

    figure = Figure((7, 2.3 * len(maps)), layout="constrained")
    axes = figure.subplots(len(maps), 3, squeeze=False)
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
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)
