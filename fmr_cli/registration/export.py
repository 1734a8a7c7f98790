"""What a registration leaves behind besides its transform: moved and merged clouds, metrics, a summary.

Clouds go from file to file a chunk at a time, so that their size does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.nearest import NearestDistance
from fmr_cli.io.stream import COLORS, CloudStream, Column, Survey, collect, stream_of
from fmr_cli.registration.result import Registration

INDEXED = 2_000_000  # points of the target, at least, that residuals are measured to: some 300 MB with their tree


def aligned_cloud(source: PointCloud | CloudStream, target: PointCloud | CloudStream, T: np.ndarray) -> CloudStream:
    """The source moved by T, with all its attributes and ``residual``: the distance to the nearest target point.

    Of a target of more than twice INDEXED points, the nearest of those that an even thinning keeps.
    """
    index = collect((PointCloud(c.points, crs=c.crs) for c in stream_of(target)), INDEXED)
    distance = NearestDistance(index.points)
    moved = stream_of(source).transformed(T).map(lambda c: replace(c, crs=index.crs or c.crs))

    def with_residual(cloud: PointCloud) -> PointCloud:
        return cloud.with_attribute("residual", distance(cloud.points).astype(np.float32))

    # What has to be known of residuals before they are written is so little that they are computed once only.
    survey = moved.survey
    anything = Column(np.dtype(np.float32), (), -np.inf, np.inf, whole=False)
    aligned = moved.map(with_residual)
    head = survey.head.with_attribute("residual", np.empty(0, np.float32))
    aligned.survey = replace(survey, head=head, columns={**survey.columns, "residual": anything})
    return aligned


def merged_cloud(
    source: PointCloud | CloudStream, target: PointCloud | CloudStream, T: np.ndarray
) -> tuple[CloudStream, list[str]]:
    """Both clouds in the target's frame with ``source_id`` (0 source, 1 target), and warnings about attributes.

    An attribute that only one of them has is 0 for the other's points; one of two widths is left out.
    """
    streams = (stream_of(source).transformed(T), stream_of(target))
    first, second = (stream.survey for stream in streams)
    columns: dict[str, Column] = {}
    warnings = []
    for name in dict.fromkeys([*first.columns, *second.columns]):
        present = [survey.columns[name] for survey in (first, second) if name in survey.columns]
        if len({column.shape for column in present}) > 1:
            warnings.append(f"attribute {name!r} has a different width in the two clouds: left out of the merged cloud")
            continue
        columns[name] = merged_column(name, present)
        if len(present) == 1:
            lacking = next(s.name for s in streams if name not in s.survey.columns)
            warnings.append(f"attribute {name!r} is not in {lacking}: 0 for its points in the merged cloud")
    own = columns | {"source_id": Column(np.dtype(np.uint8), (), 0, 1, by_257=False)}
    head = replace(
        second.head, attributes={n: np.empty((0, *c.shape), c.dtype) for n, c in own.items()}, sensor_origin=None,
        crs=second.head.crs or first.head.crs, las_header=second.head.las_header or first.head.las_header,
        left_out=tuple(dict.fromkeys((*first.head.left_out, *second.head.left_out))), scan=None, T_file_scan=None,
    )  # fmt: skip

    def chunks() -> Iterator[PointCloud]:
        for number, stream in enumerate(streams):
            for cloud in stream:
                attributes = {n: merged_values(n, c, cloud, stream.survey) for n, c in columns.items()}
                attributes["source_id"] = np.full(len(cloud), number, np.uint8)
                yield replace(head, points=cloud.points, attributes=attributes)

    merged = CloudStream(chunks, streams[1].name, turned=streams[0].turned)
    merged.survey = Survey(
        head, first.count + second.count, np.minimum(first.low, second.low), np.maximum(first.high, second.high),
        max(first.rest, second.rest), own,
    )  # fmt: skip
    return merged, warnings


def merged_column(name: str, present: list[Column]) -> Column:
    """What the values of one attribute of both clouds, or of one and zeros, have in common."""
    wide = [widened(column) for column in present] if mixed_colors(name, present) else present
    low, high = min(c.low for c in wide), max(c.high for c in wide)
    if len(present) == 1:
        low, high = min(low, 0), max(high, 0)
    return Column(
        np.result_type(*(c.dtype for c in wide)), wide[0].shape, low, high, all(c.whole for c in wide),
        sum(c.missing for c in wide), all(c.by_257 for c in wide),
    )  # fmt: skip


def mixed_colors(name: str, present: list[Column]) -> bool:
    return name in (*COLORS, "alpha") and {c.dtype for c in present} == {np.dtype(np.uint8), np.dtype(np.uint16)}


def widened(column: Column) -> Column:
    """8-bit colours as 16-bit ones."""
    if column.dtype == np.uint16:
        return column
    return replace(column, dtype=np.dtype(np.uint16), low=column.low * 257, high=column.high * 257)


def merged_values(name: str, column: Column, cloud: PointCloud, survey: Survey) -> np.ndarray:
    """An attribute of one of the clouds in the type it has in the merged one."""
    values = cloud.attributes.get(name)
    if values is None:
        return np.zeros((len(cloud), *column.shape), column.dtype)
    own = survey.columns[name].dtype
    if name in (*COLORS, "alpha") and own == np.uint8 and column.dtype == np.uint16:
        return values.astype(np.uint16) * np.uint16(257)
    return values.astype(column.dtype, copy=False)


def metrics(source: PointCloud, target: PointCloud, found: Registration) -> dict[str, Any]:
    """Everything said about a registration, with the files it is about; plain JSON types."""
    files = {
        role: {"file": cloud.name, "points": cloud.count, "dropped": cloud.dropped}
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
        if cloud.layout:
            lines.append(f"{cloud.name}: {cloud.layout}")
    return lines
