"""The report of ``fmr train``: losses, what is held out by step, and scores before and after."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from fmr_cli.registration.result import versions
from fmr_cli.report.networks import column, number_of
from fmr_cli.report.page import write_page
from fmr_cli.report.training import verdict
from fmr_cli.training.loop import Trainer
from fmr_cli.training.run import check_cells, score_table
from fmr_cli.training.run_folder import CARD, METRICS, RECIPE

SCORES = (column("setting", "Held out", "name"), column("start", "Start", "short"), column("kept", "Kept", "short"))

CHECKED = (
    column("kind", "Pairs of", "name"), column("overlap", "Overlap", "short"), column("pairs", "Pairs", "short"),
    column("right", "Right", "short"), column("aligned", "Aligned", "short"),
    column("wrong", "Wrong, yet aligned", "short"), column("matches", "Right matches", "short"),
    column("degrees", "Error, deg", "short"),
)  # fmt: skip


def write_training(path: Path, trainer: Trainer, stopped: bool) -> None:
    """The report of a run as one HTML file, from its folder and its scores."""
    folder, progress = trainer.folder.path, trainer.progress
    rows = list(csv.DictReader(io.StringIO((folder / METRICS).read_text("utf-8"))))
    before, after = trainer.quality(0)[0], trainer.quality(progress.best)[0]
    scores = [{"setting": name, "start": start, "kept": kept, "status": "", "id": ""}
              for name, start, kept in score_table(trainer)]  # fmt: skip
    write_page(
        path, "curves.html", {"groups": groups(rows, trainer.task.measure)}, ("curves.js",),
        title=f"Training run {folder.name}", status="aligned" if progress.best else "uncertain",
        words=["better than its start" if progress.best else "no better than its start", verdict(trainer, stopped)],
        figures=[
            (f"{before:.3f}", f"{trainer.task.measure}, start"), (f"{after:.3f}", f"{trainer.task.measure}, kept"),
            (str(progress.best), "epoch kept"), (str(progress.step), "steps"),
            (f"{progress.seconds / 60:.1f}", "minutes"),
        ],
        tables={}, more_tables=[{"title": "Before and after", "columns": SCORES, "rows": scores, "statuses": (),
                                 "caption": trainer.task.measured}, *checked(trainer)],
        texts=[(name, (folder / name).read_text("utf-8")) for name in (CARD, RECIPE) if (folder / name).is_file()],
        settings={"learns from": "; ".join(trainer.task.described), "folder": str(folder)}, versions=versions(),
    )  # fmt: skip


def checked(trainer: Trainer) -> list[dict[str, Any]]:
    """The table of held-out pairs through ``align``; none where none were registered."""
    if not trainer.progress.check or not trainer.progress.check["rows"]:
        return []
    rows = [dict(zip((c["key"] for c in CHECKED), cells, strict=True)) | {"status": "", "id": ""}
            for cells in check_cells(trainer.progress.check)]  # fmt: skip
    return [{"title": "Held-out pairs through align", "columns": CHECKED, "rows": rows, "statuses": (),
             "caption": "Before to after training."}]  # fmt: skip


def groups(rows: list[dict[str, str]], measure: str) -> list[dict[str, Any]]:
    """The columns of metrics.csv as plots: losses, then a plot for each held-out measure, a line for each setting."""
    names = list(rows[0]) if rows else []
    losses = [name for name in names if name.startswith("loss_")]
    held: dict[str, list[str]] = {measure: ["success"]} if "success" in names else {}
    for name in names:
        setting, _, what = name.rpartition(": ")
        if setting:
            held.setdefault(what, []).append(name)
    found = []
    if losses:
        found.append({"title": "Losses", "words": "The mean of each epoch's steps.",
                      "plots": [lines(rows, [name], name[5:], lambda n: n[5:]) for name in losses]})  # fmt: skip
    found.append({
        "title": "Held out", "words": "Step 0 is the start.",
        "plots": [lines(rows, own, what, lambda n: n.rpartition(": ")[0]) for what, own in held.items()],
    })  # fmt: skip
    return found


def lines(rows: list[dict[str, str]], names: list[str], label: str, called: Any) -> dict[str, Any]:
    series = []
    for name in names:
        points = [(number_of(row["step"]), number_of(row.get(name))) for row in rows]
        points = [(x, y) for x, y in points if y is not None]
        series.append({"name": called(name), "at": [x for x, _ in points], "values": [y for _, y in points],
                       "low": None, "high": None})  # fmt: skip
    return {"x": "step", "y": label, "log": False, "series": [s for s in series if s["values"]], "range": None}
