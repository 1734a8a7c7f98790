"""What `fmr info` says about a cloud."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud

SAMPLE = 2_000  # points whose nearest neighbour is looked up
TREE = 1_000_000  # points a k-d tree is built on at most; it takes about a second


def describe(cloud: PointCloud) -> dict[str, Any]:
    """What a cloud holds, as plain Python values (for JSON); lengths in the file's unit."""
    low, high = cloud.points.min(0), cloud.points.max(0)
    return {
        "file": cloud.name,
        "format": cloud.format,
        "points": len(cloud),
        "dropped": cloud.dropped,
        "mesh": {"vertices": cloud.mesh[0], "faces": cloud.mesh[1]} if cloud.mesh else None,
        "bounds": {"min": low.tolist(), "max": high.tolist()},
        "extent": (high - low).tolist(),
        "spacing": spacing(cloud.points),
        "attributes": {name: type_name(values) for name, values in cloud.attributes.items()},
        "crs": cloud.crs,
        "sensor_origin": None if cloud.sensor_origin is None else cloud.sensor_origin.tolist(),
        "left_out": list(cloud.left_out),
    }


def type_name(values: np.ndarray) -> str:
    """uint16, or 3 x uint16 for an (N, 3) attribute."""
    return " x ".join([*map(str, values.shape[1:]), str(values.dtype)])


def spacing(points: np.ndarray) -> float | None:
    """Median distance from a point to the nearest one elsewhere, on a fixed sample; None if all are in one place.

    points: (N, 3). In a large cloud the sample is drawn from ten slabs across its longest side, with every point of
    a slab in the tree, since thinning the points out would widen their spacing.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    slabs = [points]
    if len(points) > TREE:
        axis = int(np.argmax(points.max(0) - points.min(0)))
        order = np.argsort(points[:, axis])
        size = TREE // 10
        slabs = [points[order[start : start + size]] for start in np.linspace(0, len(points) - size, 10, dtype=int)]
    distances = []
    for slab in slabs:
        queries = slab[rng.choice(len(slab), min(len(slab), SAMPLE // len(slabs)), replace=False)]
        near = np.sort(cKDTree(slab).query(queries, k=9)[0], axis=1)  # nine, since some may be the same point again
        near[(near == 0) | np.isinf(near)] = np.nan
        distances.append(near[np.arange(len(near)), np.isnan(near).argmin(axis=1)])
    found = np.concatenate(distances)
    found = found[~np.isnan(found)]
    return float(np.median(found)) if len(found) else None


def table(said: dict[str, Any]) -> str:
    """What `describe` returned, as lines for a person."""

    def numbers(values: list[float]) -> str:
        return " ".join(f"{value:.10g}" for value in values)

    mesh, attributes = said["mesh"], said["attributes"]
    sampled = f", sampled from a mesh of {mesh['vertices']} vertices and {mesh['faces']} faces" if mesh else ""
    dropped = f", {said['dropped']} dropped (NaN or infinite)" if said["dropped"] else ""
    rows = {
        "format": said["format"],
        "points": f"{said['points']}{sampled}{dropped}",
        "min": numbers(said["bounds"]["min"]),
        "max": numbers(said["bounds"]["max"]),
        "extent": numbers(said["extent"]),
        "spacing": "none" if said["spacing"] is None else f"{said['spacing']:.4g} (median distance of neighbours)",
        "attributes": ", ".join(f"{name} ({kind})" for name, kind in attributes.items()) or "none",
        "CRS": (said["crs"] or "none").split('"')[1 if '"' in (said["crs"] or "") else 0],  # of WKT the name
        "sensor": numbers(said["sensor_origin"]) if said["sensor_origin"] else "not stated",
        "left out": ", ".join(said["left_out"]) or "nothing",
    }
    return "\n".join([said["file"], *(f"  {name:<11}{text}" for name, text in rows.items())])
