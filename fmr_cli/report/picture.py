"""A pair as a picture for papers and tickets, ``fmr align --picture``: before, after, a section, the residuals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.registration.agreement import TOUCHING
from fmr_cli.registration.result import Registration
from fmr_cli.report import plots
from fmr_cli.report.pair_page import RESIDUALS, Target
from fmr_cli.report.points import broad_side, shown

POINTS = 15_000  # of each cloud seen whole
SLICE = 0.015  # of the target's size: the thickness of the section
BLUE, ORANGE = plots.COLORS[:2]


def write_picture(path: Path, source: PointCloud, target: PointCloud, found: Registration) -> None:
    """Four panels; coordinates are relative to the target's mean. ``path``: .png, .pdf or .svg."""
    middle = target.points.mean(0)
    fixed, moving = shown(target.points, 8 * POINTS) - middle, shown(source.points, 8 * POINTS)
    after = transform_points(found.T_target_source, moving) - middle
    axes = list(broad_side(fixed).axes)
    along = next(a for a in range(3) if a not in axes)
    limit = RESIDUALS * found.voxel_size
    reference = Target(target.points - middle)
    error = reference.residuals(after, limit)
    touching = error.point <= TOUCHING * found.voxel_size
    # Through the middle of what both scans have: there a misfit shows.
    at = float(np.median(after[touching, along] if touching.any() else fixed[:, along]))
    thick = SLICE * float(np.linalg.norm(np.ptp(fixed, axis=0)))
    with plots.figure(path, plots.PAGE, 5.6) as figure:
        panels = figure.subplots(2, 2)
        top = "from above" if along == 2 else f"along {'xyz'[along]}"
        clouds(panels[0, 0], fixed[:POINTS, axes], (moving - middle)[:POINTS, axes], f"before, {top}", axes)
        clouds(panels[0, 1], fixed[:POINTS, axes], after[:POINTS, axes], f"after, {top}", axes)
        cut = [p[np.abs(p[:, along] - at) <= thick / 2][:, axes] for p in (fixed, after)]
        clouds(panels[1, 0], cut[0], cut[1], f"after, section at {'xyz'[along]} = {at:.3g}", axes, size=1.5)
        residuals(panels[1, 1], error.plane[touching], reference)
        figure.suptitle(
            f"{found.status}, confidence {found.confidence:.2f}: overlap {found.overlap:.0%}, "
            f"RMSE {found.inlier_rmse:.3g}", x=0.01, ha="left", fontsize=9,
        )  # fmt: skip
        figure.text(0.99, 0.985, "target", ha="right", va="top", color=BLUE)
        figure.text(0.93, 0.985, "source", ha="right", va="top", color=ORANGE)


def clouds(panel: Any, target: np.ndarray, source: np.ndarray, title: str, axes: list[int], size: float = 0.4) -> None:
    for points, color in ((target, BLUE), (source, ORANGE)):
        panel.scatter(*points.T, s=size, color=color, linewidths=0, rasterized=True)
    panel.set(aspect="equal", title=title, xlabel="xyz"[axes[0]], ylabel="xyz"[axes[1]])
    panel.set_anchor("W")


def residuals(panel: Any, values: np.ndarray, reference: Target) -> None:
    values = values[np.isfinite(values)]
    high = max(float(np.quantile(values, 0.95)) if len(values) else 0.0, 3 * reference.noise, 1e-12)
    panel.hist(values, bins=50, range=(0, high), color=ORANGE, weights=np.full(len(values), 100 / max(len(values), 1)))
    panel.axvline(reference.noise, color="black", linewidth=0.8, linestyle="--")
    panel.text(reference.noise, 0.97, f" noise of the target {reference.noise:.2g}", va="top", fontsize=7,
               transform=panel.get_xaxis_transform())  # fmt: skip
    panel.set(xlabel="plane error", ylabel="% of points in the overlap", title="residuals after", xlim=(0, high))
