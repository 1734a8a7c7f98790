"""The report of ``fmr evaluate``: the paper's experiments as curves with intervals, and a table of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fmr_cli.evaluation.experiments import EXPERIMENTS, Row
from fmr_cli.registration.result import versions
from fmr_cli.report.evaluation import series
from fmr_cli.report.networks import column
from fmr_cli.report.page import write_page

COLUMNS = (
    column("clouds", "Clouds", "name"), column("method", "Method", "name"), column("level", "Level"),
    column("pairs", "Pairs"), column("success", "Below 5°", "share"), column("rotation_mean", "Rotation °, mean"),
    column("rotation_median", "median"), column("shift_mean", "Shift, mean"), column("shift_median", "median"),
    column("rmse_mean", "RMSE, mean"), column("rmse_median", "median"), column("seconds", "Seconds a pair"),
)  # fmt: skip
MEASURES = (("success", "share below 5°, 95 % interval"), ("rotation_median", "median rotation error, °"),
            ("shift_median", "median shift error"))  # fmt: skip


def write_evaluation(path: Path, rows: Sequence[Row], options: dict[str, Any]) -> None:
    """The report of experiments as one HTML file; rows: those of results.csv."""
    groups, tables = [], {}
    for number, name in enumerate(dict.fromkeys(row.experiment for row in rows)):
        own = [row for row in rows if row.experiment == name]
        axis = EXPERIMENTS[name].axis
        shown = MEASURES if len({row.level for row in own}) > 1 else ()
        groups.append({
            "title": name[0].upper() + name[1:], "words": f"Level: {axis}.",
            "plots": [plot(own, measure, axis, label) for measure, label in shown],
        })  # fmt: skip
        tables[number] = {
            "columns": COLUMNS, "caption": "The same numbers; a click on a heading sorts.",
            "rows": [asdict(row) | {"status": "", "id": ""} for row in own],
        }  # fmt: skip
    write_page(
        path, "curves.html", {"groups": groups}, ("curves.js",), title="Evaluation", status="", figures=[],
        words=["The solver alone from the identity, without the search over starts and the polish of fmr align. "
               "Lengths are in units of the cloud, its largest extent about 1."],
        tables=tables, more_tables=[], texts=[], settings=options, versions=versions(),
    )  # fmt: skip


def plot(rows: list[Row], measure: str, axis: str, label: str) -> dict[str, Any]:
    lines = [
        {"name": s.label, "at": list(s.x), "values": list(s.y), "low": s.low and list(s.low),
         "high": s.high and list(s.high)} for s in series(rows, measure)
    ]  # fmt: skip
    return {
        "x": axis,
        "y": label,
        "log": False,
        "series": lines,
        "range": [-0.03, 1.05] if measure == "success" else None,
    }
