"""A sequence as one picture, ``fmr sequence --picture``: path over map, height, sigmas, status, errors by length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.evaluation.trajectory import by_length, path_segments
from fmr_cli.evaluation.truth import Truth
from fmr_cli.report import plots
from fmr_cli.report.points import density
from fmr_cli.report.sequence_page import above, box_about, in_scanner_frame, map_points, of_scanner, reader
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.result import SequenceResult
from fmr_cli.sequence.scans import Scans

PATH, UNCERTAIN, LOOPS, TRUTH = (plots.COLORS[n] for n in (0, 1, 3, 4))
HIGH, ERRORS_HIGH = 4.6, 1.7  # inches: without the errors' panels, and what these take
FLAT = 1e-3  # of the path: heights that differ less are not stretched to the whole panel
AROUND, OF_MAP = 0.35, 0.25  # of the path's size and the map's: the larger of them is drawn on each side of the path
MANY = 300  # uncertain frames, from which on their marks are small
SMALL = {"markersize": 2.5, "rasterized": True}


@dataclass(frozen=True)
class Drawn:
    """What the panels show, in the scanner's frame of the first scan.

    path (n, 4, 4), sure (n,): which frames are aligned, along (n,): the way to each; before (n, 4, 4): the path before
    loops were closed, or None; loops: pairs of frames; seen (N, 3): the map. true (k, 4, 4): true poses, with the
    first one on the path, at frames (k,); none where the truth is not known.
    """

    rows: Sequence[dict[str, Any]]
    path: np.ndarray
    sure: np.ndarray
    along: np.ndarray
    before: np.ndarray | None
    loops: Sequence[tuple[int, int]]
    seen: np.ndarray
    true: np.ndarray
    frames: np.ndarray


def write_picture(
    path: Path, result: SequenceResult, scans: Scans, options: SequenceOptions, truth: Truth | None = None
) -> None:
    """The picture of a sequence, .png, .pdf or .svg; scans: those it was made of; truth: in the frame of its poses."""
    drawn = to_draw(result, scans, options, truth)
    axes, up = above(drawn.seen, drawn.path[:, :3, 3])
    with plots.figure(path, plots.PAGE, HIGH + (ERRORS_HIGH if truth else 0)) as figure:
        upper, lower = figure.subfigures(2, 1, height_ratios=(HIGH, ERRORS_HIGH)) if truth else (figure, None)
        left, right = upper.subfigures(1, 2, width_ratios=(1.2, 1))
        draw_path(left, drawn, axes)
        height, shift, rotation, status = right.subplots(4, 1, height_ratios=(3, 2, 2, 1))
        draw_height(height, drawn, up)
        draw_by_frame(shift, drawn, "sigma_shift", "sigma, shift")
        draw_by_frame(rotation, drawn, "sigma_rotation_deg", "sigma, rotation, deg")
        draw_status(status, drawn)
        for panel in (shift, rotation):
            panel.sharex(status)
            panel.tick_params(labelbottom=False)
        if truth and lower:
            draw_errors(lower.subplots(1, 2), truth.beside(result.poses), truth.poses)


def to_draw(result: SequenceResult, scans: Scans, options: SequenceOptions, truth: Truth | None) -> Drawn:
    """Gather it; reads some of the scans again, for the map."""
    path = in_scanner_frame(result, scans, options)
    before = None if result.odometry_poses is None else in_scanner_frame(result, scans, options, odometry=True)
    true, frames = np.zeros((0, 4, 4)), np.zeros(0)
    if truth:
        true, frames = of_scanner(truth.poses, scans, options), truth.frames
        true = truth.beside(path)[0] @ np.linalg.inv(true[0]) @ true
    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    return Drawn(
        result.rows, path, np.array([row["status"] == "aligned" for row in result.rows]),
        np.concatenate([[0.0], steps.cumsum()]), before if result.closed else None, result.closed,
        map_points(path, reader(scans)), true, frames,
    )  # fmt: skip


def draw_path(figure: Any, drawn: Drawn, axes: Sequence[int]) -> None:
    a, b = axes
    panel, xy, true = figure.subplots(), drawn.path[:, (a, b), 3], drawn.true[:, (a, b), 3]
    box = about_path(drawn.seen[:, (a, b)], np.concatenate([xy, true]))
    (left, bottom), (right, top) = box
    panel.imshow(density(drawn.seen[:, (a, b)], box), extent=(left, right, bottom, top), zorder=0)
    if len(true):
        panel.plot(*true.T, color=TRUTH, linewidth=3.5, alpha=0.6, label="truth")
    if drawn.before is not None:
        panel.plot(*drawn.before[:, (a, b), 3].T, color=LOOPS, linewidth=0.9, linestyle=":", label="before loops")
    panel.plot(*xy.T, color=PATH, label="path")
    for number, pair in enumerate(drawn.loops):
        panel.plot(*xy[list(pair)].T, color=LOOPS, marker="o", markerfacecolor="none", linewidth=1,
                   label=f"loops ({len(drawn.loops)})" if number == 0 else None)  # fmt: skip
    doubtful = xy[~drawn.sure]
    if len(doubtful):
        size = SMALL if len(doubtful) > MANY else {}
        panel.plot(*doubtful.T, "^", color=UNCERTAIN, label=f"uncertain frames ({len(doubtful)})", **size)
    panel.plot(*xy[0], "s", color="black", markerfacecolor="white", markersize=5, label="start")
    panel.set(aspect="equal", adjustable="datalim", xlabel="xyz"[a], ylabel="xyz"[b])
    panel.grid(visible=False)
    panel.set_title("path over the map")
    figure.legend(loc="outside lower left", ncols=3, frameon=False, columnspacing=1.2)


def about_path(seen: np.ndarray, path: np.ndarray) -> np.ndarray:
    """(2, 2): low and high of what is drawn of the map's points (N, 2): a path (n, 2) of few metres is no dot in it."""
    box = box_about(seen, path)
    margin = max(AROUND * float(np.ptp(path, axis=0).max()), OF_MAP * float((box[1] - box[0]).max()))
    return np.stack([np.maximum(box[0], path.min(0) - margin), np.minimum(box[1], path.max(0) + margin)])


def draw_height(panel: Any, drawn: Drawn, up: int) -> None:
    """Along the way; where the truth's frames are, the way is the found path's, so that equal places stand together."""
    height, true = drawn.path[:, up, 3], drawn.true[:, up, 3]
    if len(true):
        at = np.interp(drawn.frames, np.arange(len(drawn.along)), drawn.along)
        panel.plot(at, true, color=TRUTH, linewidth=3.5, alpha=0.6)
    panel.plot(drawn.along, height, color=PATH)
    both = np.concatenate([height, true])
    middle, least = (both.max() + both.min()) / 2, FLAT * (drawn.along[-1] or 1.0)
    half = max(0.55 * float(np.ptp(both)), least)
    panel.set(ylim=(middle - half, middle + half), xlabel="along the path", ylabel="xyz"[up])
    panel.set_title("height")


def draw_by_frame(panel: Any, drawn: Drawn, name: str, title: str) -> None:
    """A value of the rows; frames that have none are gaps."""
    frames = [row["frame"] for row in drawn.rows]
    values = np.array([np.nan if row.get(name) is None else row[name] for row in drawn.rows], float)
    panel.set_title(title)
    if not np.isfinite(values).any():
        said = "every direction is observed" if drawn.sure.all() else "no frame has one"
        panel.text(0.5, 0.5, said, ha="center", va="center", transform=panel.transAxes, color=TRUTH)
        panel.set(yticks=[])
        return
    panel.plot(frames, values, color=PATH, linewidth=0.8, marker="o", **SMALL)
    doubtful = np.where(drawn.sure, np.nan, values)
    panel.plot(frames, doubtful, "^", color=UNCERTAIN, **SMALL if (~drawn.sure).sum() > MANY else {})
    panel.set_ylim(bottom=0)


def draw_status(panel: Any, drawn: Drawn) -> None:
    """A bar for each stretch of frames of one status, as wide as a line at least: one frame of thousands shows."""
    first = drawn.rows[0]["frame"]
    for row, color in enumerate((UNCERTAIN, PATH)):
        bars = [(first + low - 0.5, high - low) for low, high in stretches(drawn.sure == bool(row))]
        panel.broken_barh(bars, (row + 0.1, 0.8), color=color, linewidth=0.8)
    panel.set(yticks=[0.5, 1.5], yticklabels=["uncertain", "aligned"], ylim=(0, 2), xlabel="frame")
    panel.set_xlim(first - 0.5, first + len(drawn.sure) - 0.5)
    panel.xaxis.get_major_locator().set_params(integer=True)
    panel.grid(axis="y", visible=False)


def stretches(of: np.ndarray) -> list[tuple[int, int]]:
    """Where (n,) is true: the first of each stretch, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], of, [False]]).astype(int)))
    return [(int(low), int(high)) for low, high in edges.reshape(-1, 2)]


def draw_errors(panels: Sequence[Any], poses: np.ndarray, truth: np.ndarray) -> None:
    """Translation and rotation over segments (n, 4, 4 both) of each length, as KITTI's benchmark draws them."""
    kitti, segments = path_segments(poses, truth)
    rows = by_length(segments)
    what = "KITTI's error by length" if kitti else "error by length"
    for panel, name, unit in zip(panels, ("translation_percent", "deg_per_100"), ("%", "deg / 100"), strict=True):
        word = "translation" if unit == "%" else "rotation"
        panel.set(title=f"{what}: {word}, {unit}", xlabel="length of the segments")
        if not rows:
            panel.text(0.5, 0.5, "no segment ends within the path", ha="center", transform=panel.transAxes)
            continue
        plots.curves(panel, [plots.Series("", [r["length"] for r in rows], [r[name] for r in rows])], named=False)
        panel.set_ylim(0, 1.1 * max(r[name] for r in rows) or 1.0)
