"""The report of ``fmr evaluate``: the paper's experiments as curves with intervals, and a table of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.evaluation.benchmark import Outcome, Summary
from fmr_cli.evaluation.catalogue import EXPERIMENTS
from fmr_cli.evaluation.datasets.pair import DataSet
from fmr_cli.evaluation.experiments import Row
from fmr_cli.evaluation.quoted import Quoted
from fmr_cli.registration.result import plain, versions
from fmr_cli.report.evaluation import SHARES, series
from fmr_cli.report.networks import column, number_of
from fmr_cli.report.page import write_page
from fmr_cli.report.plots import binomial

COLUMNS = (
    column("clouds", "Clouds", "name"), column("method", "Method", "name"), column("level", "Level"),
    column("pairs", "Pairs"), column("success", "Right", "share", "below 5° if not said otherwise"),
    column("rotation_mean", "Rotation °, mean"),
    column("rotation_median", "median"), column("shift_mean", "Shift, mean"), column("shift_median", "median"),
    column("rmse_mean", "RMSE, mean"), column("rmse_median", "median"), column("seconds", "Seconds a pair"),
)  # fmt: skip
MORE = (
    column("limit_median", "Limit °"), column("limit_ratio", "Times the limit"),
    column("scale_median", "Scale off, median share"), column("aligned_right", "Aligned, right", "share"),
    column("aligned_wrong", "Aligned, wrong", "share"),
)  # fmt: skip
WORDS = {
    "refine": "Ways to take the last step, each from the same starts near the pose; the limit is the Cramér-Rao bound "
    "of point-to-plane.",
    "cross-source": "Made-up photogrammetry onto other sensors; right: below 5°, 2 % of the size and of the scale.",
    "": "The solver alone from the identity, without the search over starts and the polish of fmr align, beside fmr "
    "align itself where it was run.",
}  # of the experiments whose name begins so


def write_evaluation(path: Path, rows: Sequence[Row], options: dict[str, Any]) -> None:
    """The report of experiments as one HTML file; rows: those of results.csv."""
    groups, tables = [], {}
    for number, name in enumerate(dict.fromkeys(row.experiment for row in rows)):
        own, experiment = [row for row in rows if row.experiment == name], EXPERIMENTS[name]
        shown = experiment.measures if len({row.level for row in own}) > 1 else ()
        words = next(words for start, words in WORDS.items() if name.startswith(start))
        groups.append({
            "title": name[0].upper() + name[1:], "words": f"{words} Level: {experiment.axis}.",
            "plots": [plot(own, measure, experiment.axis, label) for measure, label in shown],
        })  # fmt: skip
        measured = [c for c in MORE if any(getattr(row, c["key"]) is not None for row in own)]
        tables[number] = {
            "columns": (*COLUMNS, *measured), "caption": "The same numbers; a click on a heading sorts.",
            "rows": [plain(asdict(row)) | {"status": "", "id": ""} for row in own],
        }  # fmt: skip
    write_page(
        path, "curves.html", {"groups": groups}, ("curves.js",), title="Evaluation", status="", figures=[],
        words=["Lengths are in units of the cloud, its largest extent about 1."],
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
        "range": [-0.03, 1.05] if measure in SHARES else None,
    }


DATASET = (
    column("method", "Method", "name"), column("from", "From", "words"), column("pairs", "Pairs"),
    column("recall", "Recall", "share", "by the data set's own definition"),
    column("interval", "95 % interval over pairs", "short"), column("rre", "RRE °"), column("rte", "RTE"),
    column("precision", "Of its aligned, right", "share"), column("share", "Called aligned", "share"),
    column("seconds", "Seconds a pair, median"),
)  # fmt: skip
PAIRS = (
    column("status", "", "status"), column("scene", "Scene", "name"), column("source", "Source", "name"),
    column("target", "Target", "name"), column("method", "Method", "name"), column("rre", "RRE °"),
    column("rte", "RTE"), column("said", "Verdict", "short"), column("confidence", "Confidence"),
    column("seconds", "Seconds"), column("message", "Message", "words"),
)  # fmt: skip
ROWS, STEPS = 4_000, 200  # of the table of pairs; of a curve


def write_dataset(
    path: Path, data: DataSet, measured: Sequence[Summary], quoted: Sequence[Quoted], rows: Sequence[Outcome],
    options: dict[str, Any],
) -> None:  # fmt: skip
    """The report of a data set: figures beside quoted ones, errors as curves, every pair; what is wrong comes first."""
    ordered = sorted(rows, key=lambda row: row.right)
    errors = [("rre", "rotation error, °"), ("rte", "shift error")]
    table = {
        "title": "Pairs", "columns": PAIRS, "statuses": ["wrong", "right"],
        "rows": [outcome_row(r) for r in ordered[:ROWS]],
        "caption": f"A row a pair and method, {min(ROWS, len(rows))} of {len(rows)}; all in pairs.csv",
    }  # fmt: skip
    figures = {
        "columns": DATASET, "rows": [*map(summary_row, measured), *map(quoted_row, quoted)],
        "caption": "Measured here, and what others published, with where it stands.",
    }  # fmt: skip
    group = {"title": "Errors", "words": "The share of the pairs whose error is at most so large.",
             "plots": [shares_below(rows, name, label) for name, label in errors]}  # fmt: skip
    write_page(
        path, "curves.html", {"groups": [group]}, ("curves.js",), title=data.name, status="", figures=[],
        words=[f"{len(data.pairs)} pairs; right: {data.right.text}", *data.notes], tables={0: figures},
        more_tables=[table], texts=[], settings=options, versions=versions(),
    )  # fmt: skip


def shares_below(rows: Sequence[Outcome], name: str, label: str) -> dict[str, Any]:
    """The share of each method's pairs below an error, over that error; pairs without an estimate count as well."""
    lines = []
    for method in dict.fromkeys(row.method for row in rows):
        error = np.sort([getattr(row, name) for row in rows if row.method == method])  # what is no number comes last
        count = int(np.isfinite(error).sum())
        chosen = np.unique(np.linspace(0, count - 1, min(STEPS, count)).round().astype(int))
        lines.append({
            "name": method, "at": [max(float(error[i]), 1e-6) for i in chosen],
            "values": [float(i + 1) / len(error) for i in chosen], "low": None, "high": None,
        })  # fmt: skip
    return {"x": label, "y": "share of the pairs", "log": False, "xlog": True, "steps": True, "range": [-0.02, 1.02],
            "series": [line for line in lines if line["at"]]}  # fmt: skip


def summary_row(row: Summary) -> dict[str, Any]:
    low, high = binomial(row.recall_of_pairs, max(row.pairs, 1))
    said = {name: number_of(getattr(row, name)) for name in ("recall", "rre", "rte", "precision", "share", "seconds")}
    return {"method": row.method, "from": "measured", "pairs": row.pairs, "status": "", "id": "",
            "interval": f"{100 * low:.0f} to {100 * high:.0f} %", **said}  # fmt: skip


def quoted_row(row: Quoted) -> dict[str, Any]:
    nothing = dict.fromkeys(("pairs", "precision", "share", "seconds"))
    return {"method": row.method, "from": f"quoted: {row.source}", "recall": row.recall and row.recall / 100,
            "interval": "", "rre": row.rre, "rte": row.rte, "status": "", "id": "", **nothing}  # fmt: skip


def outcome_row(row: Outcome) -> dict[str, Any]:
    return plain(asdict(row)) | {"status": "right" if row.right else "wrong", "said": row.status, "id": ""}
