"""What a registration leaves behind besides its transform: moved and merged clouds, metrics, a summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.registration.result import Registration

COLOURS = ("red", "green", "blue", "alpha")
CHUNK = 1 << 20  # points whose neighbours are looked up at a time


def aligned_cloud(source: PointCloud, target: PointCloud, T: np.ndarray) -> PointCloud:
    """The source moved by T, with all its attributes and ``residual``: the distance to the nearest target point."""
    from scipy.spatial import cKDTree

    moved = source.transformed(T)
    moved.crs = target.crs or source.crs
    origin = target.points.mean(0)
    tree = cKDTree(target.points - origin)
    residual = np.empty(len(moved), np.float32)
    for start in range(0, len(moved), CHUNK):
        part = slice(start, start + CHUNK)
        residual[part] = tree.query(moved.points[part] - origin, workers=-1)[0]
    return moved.with_attribute("residual", residual)


def merged_cloud(source: PointCloud, target: PointCloud, T: np.ndarray) -> tuple[PointCloud, list[str]]:
    """Both clouds in the target's frame with ``source_id`` (0 source, 1 target), and warnings about attributes."""
    merged, warnings = merged_clouds([source.transformed(T), target], "source_id")
    return replace(
        merged, path=target.path, format=target.format, dropped=target.dropped, left_out=target.left_out,
        crs=target.crs or source.crs, las_header=target.las_header or source.las_header,
    ), warnings  # fmt: skip


def merged_clouds(
    clouds: Sequence[PointCloud], label: str, numbers: Sequence[int] | None = None
) -> tuple[PointCloud, list[str]]:
    """Clouds of one frame in one, each point with its cloud's number as attribute ``label``; and warnings.

    numbers: by default the clouds' places in the list. An attribute that some of them lack is 0 for their points; one
    of two widths is left out. CRS and LAS header are those of the first that has them.
    """
    attributes, warnings = {}, []
    for name in dict.fromkeys(name for cloud in clouds for name in cloud.attributes):
        present = [cloud.attributes[name] for cloud in clouds if name in cloud.attributes]
        if len({values.shape[1:] for values in present}) > 1:
            warnings.append(f"attribute {name!r} has not one width in all clouds: left out of the merged cloud")
            continue
        parts = [
            cloud.attributes[name] if name in cloud.attributes else np.zeros((len(cloud), *present[0].shape[1:]), "u1")
            for cloud in clouds
        ]
        if name in COLOURS and {values.dtype for values in present} == {np.dtype(np.uint8), np.dtype(np.uint16)}:
            parts = [part.astype(np.uint16) * 257 if part.dtype == np.uint8 else part for part in parts]
        attributes[name] = np.concatenate([part.astype(np.result_type(*present), copy=False) for part in parts])
        lacking = [cloud.name for cloud in clouds if name not in cloud.attributes]
        if lacking:
            who = lacking[0] if len(lacking) == 1 else f"{lacking[0]} and {len(lacking) - 1} more"
            warnings.append(f"attribute {name!r} is not in {who}: 0 for their points in the merged cloud")
    ids = np.arange(len(clouds)) if numbers is None else np.asarray(numbers)
    small = np.uint8 if ids.max() < 256 else np.uint16
    attributes[label] = np.repeat(ids.astype(small), [len(cloud) for cloud in clouds])
    crs = next((cloud.crs for cloud in clouds if cloud.crs), None)
    header = next((cloud.las_header for cloud in clouds if cloud.las_header is not None), None)
    points = np.concatenate([cloud.points for cloud in clouds])
    return PointCloud(points, attributes, crs=crs, las_header=header), warnings


def metrics(source: PointCloud, target: PointCloud, found: Registration) -> dict[str, Any]:
    """Everything said about a registration, with the files it is about; plain JSON types."""
    files = {
        role: {"file": cloud.name, "points": len(cloud), "dropped": cloud.dropped}
        for role, cloud in (("source", source), ("target", target))
    }
    return {**files, **found.to_dict()}


def summary(source: PointCloud, target: PointCloud, found: Registration) -> list[str]:
    """One line for a person, and one for each thing that should not go unnoticed."""
    scale = f"scale {found.scale:.6g}, " if found.options.scale else ""
    lines = [
        f"{found.status} (confidence {found.confidence:.2f}): rotation {found.angle:.4g} deg, shift {found.shift:.6g}, "
        f"{scale}overlap {found.overlap:.0%}, RMSE {found.inlier_rmse:.3g}, {found.seconds['total']:.2f} s"
    ]
    if found.undetermined:
        lines.append(f"the scans hardly determine: {'; '.join(found.undetermined)}")
    if found.alternatives:
        lines.append(f"{len(found.alternatives)} other poses fit about as well: see alternatives in the metrics")
    for cloud in (source, target):
        if cloud.dropped:
            lines.append(f"{cloud.name}: {cloud.dropped} points without finite coordinates are left out")
    return lines
