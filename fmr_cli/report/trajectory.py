"""A path against the true one, as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fmr_cli.report import plots


def plot_paths(path: Path, poses: np.ndarray, truth: np.ndarray) -> None:
    """Both paths from above (the two axes along which the truth extends most); poses (n, 4, 4), .png, .pdf or .svg."""
    true, found = ((np.linalg.inv(p[0]) @ p)[:, :3, 3] for p in (truth, poses))
    a, b = sorted(np.argsort(np.ptp(true, axis=0))[-2:])
    with plots.figure(path, plots.COLUMN, plots.COLUMN) as figure:
        axes = figure.subplots()
        axes.plot(true[:, a], true[:, b], color=plots.COLORS[4], linewidth=3, alpha=0.6)
        axes.plot(found[:, a], found[:, b], color=plots.COLORS[0])
        axes.plot(*true[0, [a, b]], "s", color="black", markerfacecolor="white")
        axes.annotate("start", true[0, [a, b]], (5, 5), textcoords="offset points")
        axes.set(aspect="equal", xlabel="xyz"[a], ylabel="xyz"[b])
        axes.set_title("fmr", color=plots.COLORS[0])
        axes.set_title("truth", color=plots.COLORS[4], loc="right")
