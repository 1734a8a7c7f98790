"""What the reports of many pairs share: scans from above with their links, tables, pictures, what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import FmrError
from fmr_cli.io import read_cloud
from fmr_cli.report.points import Plane, broad_side, packed, pair_picture, shown

LOOKED_AT = 20_000  # points of a scan that pictures are made of
PICTURES = 150  # of pairs, the doubtful ones first: 4 kB each
FIRST = 24  # doubtful links that are shown with what to do
GROUND = 6_000  # points of all scans behind the network: an SVG stays quick
TOGETHER, EACH = 60_000, 3_000  # points of all scans in three dimensions, and of each at most
STATUSES = ("failed", "rejected", "uncertain", "aligned")  # the worst first


@dataclass
class Node:
    """A scan of a network. T_common_scan: (4, 4), None where it is not placed; points: (N, 3) some of its own."""

    name: str
    status: str
    words: str = ""
    component: int | None = None
    T_common_scan: np.ndarray | None = None
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def placed(self) -> np.ndarray:
        """The points in the frame of its component."""
        assert self.T_common_scan is not None
        return transform_points(self.T_common_scan, self.points)


@cache
def some_points(path: Path) -> np.ndarray:
    """Some points (N, 3) of a file in random order; none where it cannot be read: a picture is then missing."""
    try:
        return shown(read_cloud(path, attributes=False, at_most=LOOKED_AT).points, LOOKED_AT)
    except FmrError:
        return np.zeros((0, 3))


def points_of(source: Path | PointCloud) -> np.ndarray:
    """Some points of a scan, be it a file or in memory."""
    return shown(source.points, LOOKED_AT) if isinstance(source, PointCloud) else some_points(source)


def column(key: str, title: str, kind: str = "number", hint: str = "") -> dict[str, str]:
    return {"key": key, "title": title, "kind": kind, "hint": hint}


def number_of(text: Any) -> float | None:
    """A cell of a CSV table as a number, None where it is empty or none."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if np.isfinite(value) else None


def with_pictures(
    links: list[dict[str, Any]], clouds: Callable[[dict[str, Any]], tuple[np.ndarray, np.ndarray, np.ndarray] | None]
) -> None:
    """Gives links their pictures, the doubtful ones first. clouds: source, target, T_target_source of a link."""
    worst_first = sorted(links, key=lambda link: (STATUSES.index(link["status"]), link["confidence"] or 0.0))
    for number, link in enumerate(worst_first):
        seen = clouds(link) if number < PICTURES else None
        fine = seen is not None and len(seen[0]) > 0 and len(seen[1]) > 0
        link["picture"] = pair_picture(*seen) if fine and seen else ""


def doubtful(links: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], int]:
    """Those to look at, the most telling first (thrown out, nearly sure), and how many more there are."""
    order = {"rejected": 0, "uncertain": 1, "failed": 2}
    found = [link for link in links if link["status"] in order]
    found.sort(key=lambda link: (order[link["status"]], -(link["confidence"] or 0.0)))
    return found[:FIRST], max(len(found) - FIRST, 0)


def network_data(nodes: Sequence[Node], links: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scans and links from above, components side by side, and the placed scans' points.

    links: dicts with source and target (names), status, confidence, overlap and id.
    """
    components = sorted({n.component for n in nodes if n.component is not None and n.T_common_scan is not None})
    where: dict[str, list[float]] = {}
    ground, origin = [], 0.0
    plane = Plane((0, 1), np.zeros((2, 2)))
    for component in components:
        members = [n for n in nodes if n.component == component and len(n.points)]
        if not members:
            continue
        together = np.concatenate([n.placed[:EACH] for n in members])
        if component == components[0]:
            plane = broad_side(together)
        flat = together[:, plane.axes]
        low, high = np.quantile(flat, [0.005, 0.995], axis=0)
        offset = np.array([origin - low[0], -low[1]]) if component != components[0] else np.zeros(2)
        origin = (high[0] if component == components[0] else origin + high[0] - low[0]) + 0.15 * float((high - low)[0])
        inside = ((flat >= low) & (flat <= high)).all(1)
        ground.append(shown((flat + offset)[inside], GROUND // len(components)))
        for n in members:
            where[n.name] = (n.placed.mean(0)[list(plane.axes)] + offset).tolist()
    number = {n.name: i for i, n in enumerate(nodes)}
    names = "xyz"
    along = next(a for a in range(3) if a not in plane.axes)
    return {
        "nodes": [
            {"name": n.name, "label": short(n.name), "status": n.status, "words": n.words or n.name,
             "xy": where.get(n.name)} for n in nodes
        ] if where else [],
        "links": [
            {"source": number[k["source"]], "target": number[k["target"]], "status": k["status"], "id": k["id"],
             "words": link_words(k)} for k in links if k["source"] in number and k["target"] in number
        ],
        "ground": packed(np.concatenate(ground)) if ground else "",
        "axes": [names[a] for a in plane.axes], "seen": "above" if along == 2 else f"along {names[along]}",
        "layout_words": "Components lie side by side." if len(components) > 1 else "",
        **together_data(nodes),
    }  # fmt: skip


def together_data(nodes: Sequence[Node]) -> dict[str, Any]:
    """The placed scans' points in three dimensions, relative to the mean of the first component's."""
    placed = [n for n in nodes if n.T_common_scan is not None and len(n.points)]
    if not placed:
        return {"clouds": [], "size": 1.0}
    each = max(min(EACH, TOGETHER // len(placed)), 100)
    middles = {n.component: n.placed[:each].mean(0) for n in reversed(placed)}
    clouds = [
        {"name": n.name, "component": n.component or 0, "points": packed(n.placed[:each] - middles[n.component])}
        for n in placed
    ]
    first = np.concatenate([n.placed[:each] for n in placed if n.component == placed[0].component])
    size = float(np.linalg.norm(np.ptp(np.quantile(first, [0.02, 0.98], axis=0), axis=0)))
    return {"clouds": clouds, "size": size}


def short(name: str) -> str:
    """A name short enough to stand beside a point: of a file its stem."""
    stem = Path(name).stem if Path(name).suffix else name
    return stem if len(stem) <= 18 else f"…{stem[-17:]}"


def link_words(link: dict[str, Any]) -> str:
    """A link in the line that a pointer shows."""
    parts = [f"{link['source']} → {link['target']}: {link['status']}"]
    if link.get("confidence") is not None:
        parts.append(f"confidence {link['confidence']:.2f}")
    if link.get("overlap") is not None:
        parts.append(f"overlap {link['overlap']:.0%}")
    return ", ".join(parts)
