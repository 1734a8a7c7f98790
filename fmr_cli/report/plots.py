"""The one style of the project's plots: readable at a paper's column width, few colours, labels beside the lines.

Series differ in colour, marker and dash, so that they are told apart in grey and with every kind of colour vision, and
one that lies on another one shows through its gaps.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import FmrError
from fmr_cli.io.files import atomic_write

COLUMN, PAGE = 3.5, 7.2  # inches: widths of a column and of a page of two
# Blue and orange first, then others of Okabe and Ito's; the first series, fmr, is the boldest
COLORS = ("#0072b2", "#c26a00", "#00714f", "#a8437e", "#56606b", "#6b5bb5", "#8a6d00", "#2a8fbd")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (2, 1.5)), (0, (6, 1.5, 1, 1.5)))
STYLE = {
    "font.size": 8, "axes.titlesize": 9, "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7,
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6, "axes.grid": True,
    "grid.color": "#e3e6ea", "grid.linewidth": 0.5, "axes.axisbelow": True, "lines.linewidth": 1.3,
    "lines.markersize": 4, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "xtick.minor.size": 0,
    "ytick.minor.size": 0, "axes.titlelocation": "left", "svg.fonttype": "none", "savefig.dpi": 220,
}  # fmt: skip
NORMAL = 1.96  # deviations on either side of 95 % of a normal distribution
ABREAST = 90  # letters in one line of names above the panels
MARKER = 5  # of them, that a name's marker and the gap after it take
LINE = 1.25  # times the font's size: how far labels stand apart


def can_plot() -> bool:
    return importlib.util.find_spec("matplotlib") is not None


def check_picture(path: Path | None) -> None:
    """Before a long computation: a picture can be made. Raises FmrError."""
    if path is not None and not can_plot():
        raise FmrError(f"{path}: pictures need matplotlib; pip install 'fmr-cli[report]'")


@contextmanager
def figure(path: Path, width: float, height: float) -> Iterator[Any]:
    """A figure of so many inches to draw in, written to ``path`` at the end; .png, .pdf or .svg."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        drawn = Figure((width, height), layout="constrained")
        yield drawn
        with atomic_write(path) as temporary:
            drawn.savefig(temporary)


@dataclass(frozen=True)
class Series:
    """A line of a plot. low, high: an interval about y, or None."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None


def look(number: int) -> dict[str, Any]:
    """Of the series of that number. Later ones lie below, thicker, so that they show behind those before them."""
    return {
        "color": COLORS[number % len(COLORS)], "marker": MARKERS[number % len(MARKERS)],
        "linestyle": DASHES[number % len(DASHES)], "zorder": 3 - 0.05 * number,
    }  # fmt: skip


def curves(axes: Any, series: Sequence[Series], dodge: float = 0.0, named: bool = True) -> None:
    """Lines with markers, their intervals as bars, and each one's name at its end, if ``named``.

    dodge: by how much of the axis' length neighbours stand beside each other, so that bars and markers don't hide.
    """
    reach = max((max(s.x) - min(s.x) for s in series if len(s.x)), default=0.0) or 1.0
    for number, s in enumerate(series):
        if not len(s.x):
            continue
        x = np.asarray(s.x, float) + (number - (len(series) - 1) / 2) * dodge * reach
        axes.plot(x, s.y, **look(number))
        if s.low is not None and s.high is not None:
            axes.vlines(x, s.low, s.high, color=COLORS[number % len(COLORS)], linewidth=0.9, zorder=2)
    if named:
        end_labels(
            axes, [(number, s.label, float(s.x[-1]), float(s.y[-1])) for number, s in enumerate(series) if len(s.x)]
        )


def end_labels(axes: Any, ends: Sequence[tuple[int, str, float, float]]) -> None:
    """Names beside the lines' ends (number, name, x, y), moved apart where they would meet, with a thin line each."""
    if not ends:
        return
    size, pixel = STYLE["axes.labelsize"] - 1, axes.figure.dpi / 72  # type: ignore[operator]
    high = max(end[2] for end in ends)
    order = sorted(ends, key=lambda end: (end[3], -end[0]))
    drawn: list[Any] = []
    for _ in range(2):  # the names take room from the axes, which moves the lines' ends
        axes.figure.canvas.draw()  # lays out, after which the transforms are known
        wanted = np.array([axes.transData.transform((x, y))[1] for _, _, x, y in order]) / pixel
        apart = spread(wanted, LINE * size)
        for old in drawn:
            old.remove()
        drawn = []
        for (number, label, x, y), at, to in zip(order, wanted, apart, strict=True):
            right = (axes.transData.transform((high, y))[0] - axes.transData.transform((x, y))[0]) / pixel
            color = COLORS[number % len(COLORS)]
            drawn.append(axes.annotate(
                label, (x, y), (right + 14, to - at), textcoords="offset points", va="center", fontsize=size,
                color=color, annotation_clip=False,
                arrowprops={"arrowstyle": "-", "linewidth": 0.5, "color": color, "shrinkB": 3},
            ))  # fmt: skip


def spread(wanted: np.ndarray, least: float) -> np.ndarray:
    """Places in rising order at least so far apart, as near to those wanted (n,), rising, as they can be together."""
    # With the distances taken out, the nearest rising sequence (isotonic regression: pool adjacent violators).
    blocks: list[list[float]] = []
    for value in wanted - least * np.arange(len(wanted)):
        blocks.append([float(value), 1.0])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, n), (b, m) = blocks[-2:]
            blocks[-2:] = [[(a * n + b * m) / (n + m), n + m]]
    places = np.concatenate([np.full(int(n), value) for value, n in blocks]) if blocks else np.zeros(0)
    return places + least * np.arange(len(wanted))


def dots(axes: Any, rows: Sequence[str], series: Sequence[Series]) -> None:
    """A row for each name, from above, and in it a dot for each series with its interval, side by side.

    x of a series: the rows' numbers; y: its values, drawn along the horizontal axis.
    """
    step = 0.7 / max(len(series), 1)
    for number, s in enumerate(series):
        at = np.asarray(s.x, float) + (number - (len(series) - 1) / 2) * step
        style = look(number)
        if s.low is not None and s.high is not None:
            axes.hlines(at, s.low, s.high, color=style["color"], linewidth=1.0, zorder=2)
        axes.plot(s.y, at, linestyle="", **{k: style[k] for k in ("color", "marker", "zorder")}, clip_on=False)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    for row in range(1, len(rows)):
        axes.axhline(row - 0.5, color="#e3e6ea", linewidth=0.5, zorder=0)


def names_above(figure: Any, labels: Sequence[str], lines: bool = False) -> None:
    """The series' names in their colours with their markers, or lines, above all panels."""
    from matplotlib.lines import Line2D

    without = {"marker": ""} if lines else {"linestyle": ""}
    handles = [Line2D([], [], **{**look(n), **without}, label=label) for n, label in enumerate(labels)]
    columns = max(ABREAST // (max(map(len, labels)) + MARKER), 1)
    figure.legend(handles=handles, loc="outside upper left", ncols=columns, frameon=False, labelcolor="linecolor",
                  handletextpad=0.2, columnspacing=1.2)  # fmt: skip


def binomial(share: float, count: int) -> tuple[float, float]:
    """The 95 % interval of a share of ``count`` independent trials (Wilson 1927)."""
    z2 = NORMAL**2 / count
    middle = (share + z2 / 2) / (1 + z2)
    half = NORMAL * np.sqrt(share * (1 - share) / count + z2 / 4 / count) / (1 + z2)
    return max(float(middle - half), 0.0), min(float(middle + half), 1.0)
