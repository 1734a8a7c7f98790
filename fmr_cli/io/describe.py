"""What `fmr info` says about a cloud, of any size."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.io.stream import CloudStream, Column, collect, stream_of

SAMPLE = 2_000  # points whose nearest neighbour is looked up
TREE = 1_000_000  # points a k-d tree is built on at most; it takes about a second
SLABS = 10


def describe(cloud: PointCloud | CloudStream) -> dict[str, Any]:
    """What a cloud holds, as plain Python values (for JSON); lengths in the file's unit."""
    stream = stream_of(cloud)
    survey = stream.survey
    head = survey.head
    return {
        "file": stream.name,
        "format": head.format,
        "layout": head.layout,
        "points": survey.count,
        "dropped": head.dropped,
        "mesh": {"vertices": head.mesh[0], "faces": head.mesh[1]} if head.mesh else None,
        "bounds": {"min": survey.low.tolist(), "max": survey.high.tolist()},
        "extent": (survey.high - survey.low).tolist(),
        "spacing": spacing(stream),
        "attributes": {name: type_name(column) for name, column in survey.columns.items()},
        "missing": {name: column.missing for name, column in survey.columns.items() if column.missing},
        "crs": head.crs,
        "sensor_origin": None if head.sensor_origin is None else head.sensor_origin.tolist(),
        "left_out": list(head.left_out),
        "notes": list(head.notes),
    }


def type_name(column: Column) -> str:
    """uint16, or 3 x uint16 for an (N, 3) attribute."""
    return " x ".join([*map(str, column.shape), str(column.dtype)])


def spacing(stream: CloudStream) -> float | None:
    """Median distance from a point to the nearest one elsewhere, on a fixed sample; None if all are in one place.

    Of a large cloud the sample is drawn from ten slabs across its longest side, with every point of a slab in the
    tree, since thinning the points out would widen their spacing.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    distances = []
    for slab in slabs_of(stream):
        wanted = SAMPLE if len(slab) == stream.survey.count else SAMPLE // SLABS
        queries = slab[rng.choice(len(slab), min(len(slab), wanted), replace=False)]
        near = np.sort(cKDTree(slab).query(queries, k=9)[0], axis=1)  # nine, since some may be the same point again
        near[(near == 0) | np.isinf(near)] = np.nan
        distances.append(near[np.arange(len(near)), np.isnan(near).argmin(axis=1)])
    found = np.concatenate(distances)
    found = found[~np.isnan(found)]
    return float(np.median(found)) if len(found) else None


def slabs_of(stream: CloudStream) -> list[np.ndarray]:
    """All points (N, 3), or of many those in ten slabs across the longest side, TREE / 10 in each at most."""
    survey = stream.survey
    if survey.count <= TREE:
        return [np.concatenate([*stream.coordinates()])]
    axis = int(np.argmax(survey.high - survey.low))
    thin = np.sort(collect(map(PointCloud, stream.coordinates()), TREE // SLABS).points[:, axis])
    share = TREE / SLABS / survey.count  # of all points, that a slab is to hold
    starts = np.linspace(0, len(thin) * (1 - share), SLABS).astype(int)
    bounds = [(thin[start], thin[min(start + max(int(len(thin) * share), 1), len(thin) - 1)]) for start in starts]
    parts: list[list[np.ndarray]] = [[] for _ in bounds]
    held = np.zeros(SLABS, int)
    for points in stream.coordinates():
        values = points[:, axis].copy()  # side by side in memory
        for k, (low, high) in enumerate(bounds):
            if held[k] < TREE // SLABS * 2:  # where many lie in one plane, a slab of no width holds them all
                inside = points[(values >= low) & (values <= high)]
                parts[k].append(inside)
                held[k] += len(inside)
    return [slab for slab in map(np.concatenate, parts) if len(slab)]


def table(said: dict[str, Any]) -> str:
    """What `describe` returned, as lines for a person."""

    def numbers(values: list[float]) -> str:
        return " ".join(f"{value:.10g}" for value in values)

    mesh, attributes = said["mesh"], said["attributes"]
    sampled = f", sampled from a mesh of {mesh['vertices']} vertices and {mesh['faces']} faces" if mesh else ""
    dropped = f", {said['dropped']} dropped (NaN or infinite)" if said["dropped"] else ""
    missing = {name: f", {count} missing" for name, count in said["missing"].items()}
    rows = {
        "format": f"{said['format']}{': ' if said['layout'] else ''}{said['layout'] or ''}",
        "points": f"{said['points']}{sampled}{dropped}",
        "min": numbers(said["bounds"]["min"]),
        "max": numbers(said["bounds"]["max"]),
        "extent": numbers(said["extent"]),
        "spacing": "none" if said["spacing"] is None else f"{said['spacing']:.4g} (median distance of neighbours)",
        "attributes": ", ".join(f"{name} ({kind}{missing.get(name, '')})" for name, kind in attributes.items())
        or "none",
        "CRS": (said["crs"] or "none").split('"')[1 if '"' in (said["crs"] or "") else 0],  # of WKT the name
        "sensor": numbers(said["sensor_origin"]) if said["sensor_origin"] else "not stated",
        "left out": ", ".join(said["left_out"]) or "nothing",
    }
    rows |= {"note": "; ".join(said["notes"])} if said["notes"] else {}
    return "\n".join([said["file"], *(f"  {name:<11}{text}" for name, text in rows.items())])
