"""How true the verdict is: how often the poses of each confidence are right, as a table and a plot."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from fmr_cli.registration.confidence import ALIGNED
from fmr_cli.report import plots

BINS = (0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.01)  # edges in confidence; the last bin holds 1


def calibration_table(confidence: np.ndarray, right: np.ndarray) -> str:
    """The share of right poses by confidence, and precision and recall of `aligned`; both (pairs,)."""
    lines = ["confidence   pairs  right"]
    for low, high in itertools.pairwise(BINS):
        here = (confidence >= low) & (confidence < high)
        share = right[here].mean() if here.any() else np.nan
        lines.append(f"{low:.2f} to {min(high, 1):.2f}  {here.sum():5d}  {share:.3f}")
    called = confidence >= ALIGNED
    precision = right[called].mean() if called.any() else np.nan
    recall = called[right].mean() if right.any() else np.nan
    lines.append(f"aligned: precision {precision:.4f}, recall of right poses {recall:.4f}")
    return "\n".join(lines)


def plot_calibration(path: Path, confidence: np.ndarray, right: np.ndarray) -> None:
    """Confidence against the share that is right, in tenths of the pairs; an image file by the path's suffix."""
    edges = np.quantile(confidence, np.linspace(0, 1, 11))
    bins = [(confidence >= a) & (confidence <= b) for a, b in itertools.pairwise(edges)]
    shares = [float(right[b].mean()) for b in bins]
    low, high = zip(*(plots.binomial(s, int(b.sum())) for s, b in zip(shares, bins, strict=True)), strict=True)
    with plots.figure(path, plots.COLUMN, plots.COLUMN) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=plots.COLORS[4], linewidth=0.8)
        axes.annotate("as said", (0.5, 0.5), (4, -8), textcoords="offset points", color=plots.COLORS[4])
        middles = [float(confidence[b].mean()) for b in bins]
        axes.vlines(middles, low, high, color=plots.COLORS[0], linewidth=0.9)
        axes.plot(middles, shares, "o", color=plots.COLORS[0])
        axes.set(xlabel="confidence", ylabel="share that is right (95 % interval)",
                 title=f"{len(confidence)} pairs not fitted")  # fmt: skip
