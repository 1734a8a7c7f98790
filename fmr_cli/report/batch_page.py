"""The report of ``fmr batch``: a table of pairs to sort and filter, and where pairs share scans, their network."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import FmrError
from fmr_cli.io import read_transform
from fmr_cli.registration.result import versions
from fmr_cli.report import networks
from fmr_cli.report.networks import Node, column
from fmr_cli.report.page import write_page

LINKS = (
    column("picture", "Picture", "picture"), column("status", "Status", "status"), column("source", "Source", "name"),
    column("target", "Target", "name"), column("confidence", "Confidence"), column("overlap", "Overlap", "share"),
    column("inlier_rmse", "Surface error (RMSE)"), column("seconds", "Seconds"), column("message", "Message", "words"),
)  # fmt: skip


def write_batch(path: Path, folder: Path, out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """The report of a batch as one HTML file.

    folder: what the manifest's paths are relative to. out: the batch's folder. rows: those of its results.csv.
    """
    pairs = [pair_row(row, number) for number, row in enumerate(rows)]
    poses = {pair["id"]: T for pair, row in zip(pairs, rows, strict=True) if (T := pose(out, row)) is not None}

    def seen(pair: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        if pair["id"] not in poses:
            return None
        source, target = (networks.some_points(folder / pair[role]) for role in ("source", "target"))
        return source, target, poses[pair["id"]]

    networks.with_pictures(pairs, seen)
    count = Counter(pair["status"] for pair in pairs)
    to_do, more = networks.doubtful(pairs)
    nodes = spanning_nodes(folder, pairs, poses)
    nothing: dict[str, Any] = {"nodes": [], "links": [], "seen": "", "layout_words": ""}
    data = networks.network_data(nodes, pairs) if nodes else nothing
    if nodes:
        data["layout_words"] += " Placed by the surest links, without an adjustment; fmr multiway does better."
    settings = out / "settings.json"
    write_page(
        path, "network.html", data | {"clouds": []}, ("clouds.js", "network.js"), title=f"Batch of {len(pairs)} pairs",
        status="aligned" if count["aligned"] == len(pairs) else "uncertain",
        words=[", ".join(f"{count[s]} {s}" for s in ("aligned", "uncertain", "failed"))],
        figures=[(str(count[s]), f"pairs {s}") for s in ("aligned", "uncertain", "failed")], links=pairs,
        link_columns=LINKS, link_statuses=[s for s in networks.STATUSES if count[s]], scans=[], scan_columns=[],
        scan_statuses=[], doubtful=to_do, more_doubtful=more, components=[],
        settings=json.loads(settings.read_text("utf-8")) if settings.is_file() else {}, seconds={},
        versions=versions(),
    )  # fmt: skip


def pair_row(row: dict[str, Any], number: int) -> dict[str, Any]:
    numbers = {name: networks.number_of(row.get(name)) for name in ("confidence", "overlap", "inlier_rmse", "seconds")}
    message = row.get("message") or ""
    what = {
        "failed": "Check the two files with fmr info.",
        "uncertain": "fmr align with --report shows why, and the other poses to switch between.",
    }.get(row["status"], "")
    return {"id": f"pair-{number}", "status": row["status"], "source": row["source"], "target": row["target"],
            **numbers, "message": message, "what": what}  # fmt: skip


def pose(out: Path, row: dict[str, Any]) -> np.ndarray | None:
    try:
        return read_transform(out / row["transform"]) if row.get("transform") else None
    except FmrError:
        return None


def spanning_nodes(folder: Path, pairs: list[dict[str, Any]], poses: dict[str, np.ndarray]) -> list[Node]:
    """The scans, each placed along the surest aligned pairs from another one; none where no scan is in two pairs."""
    names = list(dict.fromkeys(name for pair in pairs for name in (pair["target"], pair["source"])))
    if max(Counter(name for pair in pairs for name in (pair["source"], pair["target"])).values(), default=0) < 2:
        return []
    sure = sorted((p for p in pairs if p["status"] == "aligned" and p["id"] in poses), key=lambda p: -p["confidence"])
    component: dict[str, int] = {}
    placed: dict[str, np.ndarray] = {}
    for name in names:  # Prim's algorithm from the first scan that is not placed yet
        if name in placed or not any(name in (p["source"], p["target"]) for p in sure):
            continue
        component[name], placed[name] = len(set(component.values())), np.eye(4)
        while link := next((p for p in sure if (p["source"] in placed) != (p["target"] in placed)), None):
            T, a, b = poses[link["id"]], link["source"], link["target"]
            new, known = (a, b) if b in placed else (b, a)
            placed[new] = placed[known] @ (T if new == a else np.linalg.inv(T))
            component[new] = component[known]
    return [
        Node(name, "placed" if name in placed else "unplaced", name, component.get(name), placed.get(name),
             networks.some_points(folder / name)) for name in names
    ]  # fmt: skip
