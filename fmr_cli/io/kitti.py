"""KITTI .bin: float32 x, y, z, intensity, nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import lost_context


def read(path: Path, attributes: bool) -> PointCloud:
    size = path.stat().st_size
    if size % 16:
        raise CloudFileError(f"holds {size} bytes, and a KITTI .bin has 16 a point (float32 x y z intensity)")
    rows = np.fromfile(path, "<f4").reshape(-1, 4)
    kept = {"intensity": rows[:, 3].copy()} if attributes else {}
    return PointCloud(rows[:, :3], kept, sensor_origin=np.zeros(3))


def write(path: Path, cloud: PointCloud) -> list[str]:
    rows = np.zeros((len(cloud), 4), "<f4")
    with np.errstate(over="ignore"):
        rows[:, :3] = cloud.points
    if not np.isfinite(rows).all():
        raise CloudFileError("coordinates beyond 3e38 do not fit into float32, write .ply or .las")
    warnings = []
    error = float(np.abs(rows[:, :3] - cloud.points).max())
    if error > 0:
        warnings.append(f".bin holds float32 only: coordinates are rounded by up to {error:.2g}")
    intensity = cloud.attributes.get("intensity")
    if intensity is None or intensity.ndim != 1:
        warnings.append(".bin has an intensity for each point and the cloud has none: zeros are written")
    else:
        rows[:, 3] = intensity
        if not np.array_equal(rows[:, 3], intensity, equal_nan=intensity.dtype.kind == "f"):
            warnings.append(".bin holds float32 only: intensity is rounded")
    lost = [name for name in cloud.attributes if name != "intensity"]
    if lost:
        warnings.append(f".bin cannot hold the attributes {', '.join(lost)}: left out")
    rows.tofile(path)
    return warnings + lost_context(cloud, ".bin")
