"""What a registration leaves behind besides its transform: moved and merged clouds, metrics, a summary."""

from __future__ import annotations

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
    """Both clouds in the target's frame with ``source_id`` (0 source, 1 target), and warnings about attributes.

    An attribute that only one of them has is 0 for the other's points; one of two widths is left out.
    """
    clouds = (source.transformed(T), target)
    attributes, warnings = {}, []
    for name in dict.fromkeys([*clouds[0].attributes, *target.attributes]):
        present = [cloud.attributes[name] for cloud in clouds if name in cloud.attributes]
        if len({values.shape[1:] for values in present}) > 1:
            warnings.append(f"attribute {name!r} has a different width in the two clouds: left out of the merged cloud")
            continue
        parts = [
            cloud.attributes[name] if name in cloud.attributes else np.zeros((len(cloud), *present[0].shape[1:]), "u1")
            for cloud in clouds
        ]
        if name in COLOURS and {values.dtype for values in present} == {np.dtype(np.uint8), np.dtype(np.uint16)}:
            parts = [part.astype(np.uint16) * 257 if part.dtype == np.uint8 else part for part in parts]
        attributes[name] = np.concatenate([part.astype(np.result_type(*present), copy=False) for part in parts])
        if len(present) == 1:
            lacking = next(cloud for cloud in (source, target) if name not in cloud.attributes)
            warnings.append(f"attribute {name!r} is not in {lacking.name}: 0 for its points in the merged cloud")
    attributes["source_id"] = np.repeat(np.array([0, 1], np.uint8), [len(source), len(target)])
    points = np.concatenate([cloud.points for cloud in clouds])
    return replace(
        target, points=points, attributes=attributes, sensor_origin=None,
        crs=target.crs or source.crs, las_header=target.las_header or source.las_header,
    ), warnings  # fmt: skip


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
