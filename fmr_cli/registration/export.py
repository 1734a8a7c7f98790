"""What a registration leaves behind besides its transform: moved and merged clouds, metrics, a summary.

Clouds go from file to file a chunk at a time, so that their size does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.nearest import NearestDistance
from fmr_cli.io.stream import COLORS, CloudStream, Column, Survey, collect, stream_of
from fmr_cli.registration.result import Registration
from fmr_cli.registration.sites import START as BY_SITE

INDEXED = 2_000_000  # points of the target, at least, that residuals are measured to: some 300 MB with their tree


def aligned_cloud(source: PointCloud | CloudStream, target: PointCloud | CloudStream, T: np.ndarray) -> CloudStream:
    """The source moved by T, with all its attributes and ``residual``: the distance to the nearest target point.

    Of a target of more than twice INDEXED points, the nearest of those that an even thinning keeps.
    """
    index = collect((PointCloud(c.points, crs=c.crs) for c in stream_of(target).bare()), INDEXED)
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
    """Both clouds in the target's frame with ``source_id`` (0 source, 1 target), and warnings about attributes."""
    return merged_clouds([stream_of(source).transformed(T), stream_of(target)], "source_id", like=1)


def merged_clouds(
    clouds: Sequence[PointCloud | CloudStream], label: str, numbers: Sequence[int] | None = None, like: int = 0
) -> tuple[CloudStream, list[str]]:
    """Clouds of one frame in one, each point with its cloud's number as attribute ``label``; and warnings.

    numbers: by default the clouds' places in the list. like: the place of the one whose file the result is like; CRS
    and LAS header are its own, else those of the first that has them. An attribute that some of them lack is 0 for
    their points; one of two widths is left out.
    """
    streams = [stream_of(cloud) for cloud in clouds]
    surveys = [stream.survey for stream in streams]
    ids = list(range(len(streams))) if numbers is None else list(numbers)
    columns: dict[str, Column] = {}
    warnings = []
    for name in dict.fromkeys(name for survey in surveys for name in survey.columns):
        present = [survey.columns[name] for survey in surveys if name in survey.columns]
        if len({column.shape for column in present}) > 1:
            warnings.append(f"attribute {name!r} has not one width in all clouds: left out of the merged cloud")
            continue
        lacking = [stream.name for stream in streams if name not in stream.survey.columns]
        columns[name] = merged_column(name, present, bool(lacking))
        if lacking:
            who = lacking[0] if len(lacking) == 1 else f"{lacking[0]} and {len(lacking) - 1} more"
            warnings.append(f"attribute {name!r} is not in {who}: 0 for their points in the merged cloud")
    small = np.dtype(np.uint8 if max(ids) < 256 else np.uint16)
    own = columns | {label: Column(small, (), 0, max(ids), by_257=False)}
    heads = [surveys[like].head, *(survey.head for survey in surveys)]
    head = replace(
        heads[0], attributes={n: np.empty((0, *c.shape), c.dtype) for n, c in own.items()}, sensor_origin=None,
        crs=next((h.crs for h in heads if h.crs), None),
        las_header=next((h.las_header for h in heads if h.las_header is not None), None),
        left_out=tuple(dict.fromkeys(what for h in heads for what in h.left_out)), scan=None, T_file_scan=None,
    )  # fmt: skip

    def chunks() -> Iterator[PointCloud]:
        for number, stream in zip(ids, streams, strict=True):
            for cloud in stream:
                attributes = {n: merged_values(n, c, cloud, stream.survey) for n, c in columns.items()}
                attributes[label] = np.full(len(cloud), number, small)
                yield replace(head, points=cloud.points, attributes=attributes)

    merged = CloudStream(chunks, streams[like].name, turned=streams[0].turned)
    merged.survey = Survey(
        head, sum(s.count for s in surveys), np.minimum.reduce([s.low for s in surveys]),
        np.maximum.reduce([s.high for s in surveys]), max(s.rest for s in surveys), own,
    )  # fmt: skip
    return merged, warnings


def merged_column(name: str, present: list[Column], with_zeros: bool) -> Column:
    """What the values of one attribute of several clouds have in common, some of which may have zeros in its place."""
    wide = [widened(column) for column in present] if mixed_colors(name, present) else present
    low, high = min(c.low for c in wide), max(c.high for c in wide)
    if with_zeros:
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
    scale = f"scale {found.scale:.6g}, " if found.options.scale or found.options.unit else ""
    scale += "mirrored, " if found.mirrored else ""
    lines = [
        f"{found.status} (confidence {found.confidence:.2f}): rotation {found.angle:.4g} deg, shift {found.shift:.6g}, "
        f"{scale}overlap {found.overlap:.0%}, RMSE {found.inlier_rmse:.3g}, {found.seconds['total']:.2f} s"
    ]
    lines += found.reasons
    if found.start == BY_SITE:
        lines.append(
            "by way of a site that the model knows: both scans were found there, whatever they share themselves"
        )
    if found.alternatives:
        lines.append(f"{len(found.alternatives)} other poses fit about as well: see alternatives in the metrics")
    for cloud in (source, target):
        if cloud.dropped:
            lines.append(f"{cloud.name}: {cloud.dropped} points without finite coordinates are left out")
        if cloud.layout:
            lines.append(f"{cloud.name}: {cloud.layout}")
    return lines
