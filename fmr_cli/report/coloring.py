"""What the points of `fmr view` are coloured by: their file, or a value of each, on a scale that all clouds share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.sampling import sample
from fmr_cli.io.stream import COLORS
from fmr_cli.report.points import SOURCE, TARGET

Coloring = Literal["file", "height", "intensity", "rgb", "residual"]
MEASURED = 200_000  # points of a cloud that residuals are measured to
# Of clouds by file: those of the reports, then others told apart with every kind of colour vision (Okabe and Ito)
HUES = np.array([TARGET, SOURCE, (0, 158, 115), (204, 121, 167), (86, 180, 233), (120, 94, 240)]) / 255
# From few to many, light growing evenly enough to read in grey; the same on pages (clouds.js)
RAMP = np.array([(36, 92, 190), (42, 143, 189), (143, 199, 122), (242, 193, 78), (200, 50, 31)]) / 255


def with_residuals(clouds: list[PointCloud]) -> list[PointCloud]:
    """Each with the distances of its points to the nearest point of the others, as attribute ``residual``."""
    rng = np.random.default_rng(0)
    some = [sample(c.points, MEASURED // len(clouds), rng) for c in clouds]
    found = []
    for n, cloud in enumerate(clouds):
        others = np.concatenate([p for k, p in enumerate(some) if k != n])
        found.append(cloud.with_attribute("residual", cKDTree(others).query(cloud.points)[0]))
    return found


def values_of(cloud: PointCloud, by: Coloring) -> np.ndarray | None:
    """The numbers (N,) that a cloud is coloured by; None where it has none."""
    if by == "height":
        return cloud.points[:, 2]
    values = cloud.attributes.get(by)
    return None if values is None or values.ndim != 1 else values.astype(float)


def rgb_of(cloud: PointCloud) -> np.ndarray | None:
    """The points' own colours (N, 3) from 0 to 1, or None."""
    if not all(name in cloud.attributes for name in COLORS):
        return None
    rgb = np.stack([cloud.attributes[name] for name in COLORS], 1).astype(float)
    most = float(rgb.max(initial=0.0))
    return rgb / (1.0 if most <= 1 else 255.0 if most <= 255 else 65535.0)


def colors(clouds: Sequence[PointCloud], by: Coloring) -> list[np.ndarray]:
    """Of each cloud's points (N, 3), from 0 to 1; what has not what is asked for is coloured by file."""
    values = [values_of(c, by) for c in clouds] if by not in ("file", "rgb") else [None] * len(clouds)
    known = [v for v in values if v is not None and len(v)]
    low, high = np.quantile(np.concatenate(known), [0.02, 0.98]) if known else (0.0, 1.0)
    found = []
    for n, (cloud, value) in enumerate(zip(clouds, values, strict=True)):
        own = rgb_of(cloud) if by == "rgb" else None
        if value is not None:
            share = np.clip((np.nan_to_num(value) - low) / max(high - low, 1e-300), 0, 1) * (len(RAMP) - 1)
            own = np.stack([np.interp(share, np.arange(len(RAMP)), channel) for channel in RAMP.T], 1)
        found.append(np.tile(HUES[n % len(HUES)], (len(cloud), 1)) if own is None else own)
    return found


def missing(clouds: Sequence[PointCloud], by: Coloring) -> list[str]:
    """A line for clouds that do not have what they are to be coloured by."""
    lacking = [
        c.name for c in clouds
        if (by == "rgb" and rgb_of(c) is None) or (by not in ("rgb", "file") and values_of(c, by) is None)
    ]  # fmt: skip
    return [f"{', '.join(lacking[:3])}: no {by}, coloured by file"] if lacking else []
