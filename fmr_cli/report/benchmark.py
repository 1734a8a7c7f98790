"""A data set's results for people and programs: the table beside quoted figures, results.csv, pairs.csv, a plot."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Column, Table

from fmr_cli.evaluation.benchmark import Outcome, Summary
from fmr_cli.evaluation.datasets.pair import DataSet
from fmr_cli.evaluation.quoted import Quoted
from fmr_cli.io.files import atomic_write
from fmr_cli.report import plots

COLUMNS = (
    "dataset", "method", "measured", "pairs", "recall", "recall_of_pairs", "rre_deg", "rte", "precision_of_aligned",
    "share_aligned", "right_that_are_aligned", "median_seconds", "failed", "source",
)  # fmt: skip


def number(value: float | None, form: str) -> str:
    return "" if value is None or not np.isfinite(value) else format(value, form)


def table(dataset: DataSet, measured: Sequence[Summary], quoted: Sequence[Quoted]) -> Table:
    """What was measured here, a line, and what others published; below it where that stands, by its number."""
    sources = list(dict.fromkeys(other.source for other in quoted))
    shown = Table(
        Column("method", min_width=14), "recall\n%", "RRE\ndeg", "RTE", "aligned:\nright", "share", "s a\npair",
        Column("from", min_width=6),
    )  # fmt: skip
    shown.title = f"{dataset.name}: {len(dataset.pairs)} pairs; right: {dataset.right.text}"
    for row in measured:
        verdict = [number(100 * x, ".1f") for x in (row.precision, row.share)]
        shown.add_row(row.method, number(100 * row.recall, ".1f"), number(row.rre, ".3f"), number(row.rte, ".4f"),
                      *verdict, number(row.seconds, ".3f"), "here")  # fmt: skip
    shown.add_section()
    for other in quoted:
        shown.add_row(other.method, number(other.recall, ".1f"), number(other.rre, ".3f"), number(other.rte, ".4f"),
                      "", "", "", f"({1 + sources.index(other.source)})", style="dim")  # fmt: skip
    shown.caption = "\n".join(f"({number}) quoted: {source}" for number, source in enumerate(sources, 1))
    shown.caption_justify = "left"
    return shown


def write_results(path: Path, dataset: DataSet, measured: Sequence[Summary], quoted: Sequence[Quoted]) -> None:
    """A row a method; recall and shares in percent; ``measured`` is yes, or no of what is quoted."""
    rows: list[dict[str, Any]] = []
    for r in measured:
        percent = [number(100 * x, ".4g") for x in (r.recall, r.recall_of_pairs, r.precision, r.share, r.found)]
        values = (dataset.name, r.method, "yes", r.pairs, *percent[:2], number(r.rre, ".6g"), number(r.rte, ".6g"),
                  *percent[2:], number(r.seconds, ".4g"), r.failed, "")  # fmt: skip
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    for q in quoted:
        rows.append({"dataset": dataset.name, "method": q.method, "measured": "no", "recall": number(q.recall, "g"),
                     "rre_deg": number(q.rre, "g"), "rte": number(q.rte, "g"), "source": q.source})  # fmt: skip
    write_rows(path, COLUMNS, rows)


def write_pairs(path: Path, outcomes: Sequence[Outcome]) -> None:
    """A row for each pair and method."""
    rows = [asdict(row) | {"right": int(row.right)} for row in outcomes]
    for row in rows:
        row |= {name: number(row[name], ".6g") for name in ("rre", "rte", "rmse", "confidence", "seconds")}
    write_rows(path, [f.name for f in fields(Outcome)], rows)


def write_rows(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")


def plot(path: Path, dataset: DataSet, outcomes: Sequence[Outcome]) -> None:
    """The share of the pairs whose error is below a bound, over that bound: rotation and shift, a line a method."""
    methods = list(dict.fromkeys(row.method for row in outcomes))
    with plots.figure(path, plots.PAGE, 2.9) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for panel, name, label in zip(
            panels, ("rre", "rte"), ("rotation error, deg", "shift, scans' unit"), strict=True
        ):
            for number_, method in enumerate(methods):
                error = np.sort([getattr(row, name) for row in outcomes if row.method == method])
                style = {k: v for k, v in plots.look(number_).items() if k != "marker"}
                panel.step(np.maximum(error, 1e-9), np.arange(1, len(error) + 1) / len(error), where="post", **style)
            finite = [e for row in outcomes if np.isfinite(e := getattr(row, name)) and e > 0]
            panel.set(xscale="log", xlabel=label, ylim=(-0.02, 1.02))
            if finite:
                panel.set_xlim(max(np.quantile(finite, 0.02) / 2, 1e-6), max(finite) * 1.1)
        panels[0].set(ylabel="share of the pairs", title=f"{dataset.name}, {len(dataset.pairs)} pairs")
        plots.names_above(figure, methods, lines=True)
