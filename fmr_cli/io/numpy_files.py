"""NPY: an (N, 3+) array or records with x, y, z. NPZ: `points` (N, 3), attributes, `crs` and `sensor_origin`."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import bare_cloud, lost_context, to_cloud

DEFLATE_LIMIT = 1100  # zip cannot shrink data more than this many times
OWN = ("points", "crs", "sensor_origin", "file")  # names an attribute in an NPZ cannot have


def read(path: Path, attributes: bool) -> PointCloud:
    if path.suffix.lower() == ".npz":
        return read_npz(path, attributes)
    with path.open("rb") as file:
        array = read_array(file, path.stat().st_size)
    if array.dtype.names:
        return to_cloud({name: array[name] for name in array.dtype.names}, attributes)
    return bare_cloud(array, attributes)


def read_npz(path: Path, attributes: bool) -> PointCloud:
    with zipfile.ZipFile(path) as archive:
        entries = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        key = "points" if "points" in entries else next(iter(entries), None)
        if key is None or (key != "points" and len(entries) > 1):
            raise CloudFileError(f"has no array 'points' (N, 3) among {', '.join(entries) or 'nothing'}")

        def load(name: str) -> np.ndarray:
            info = entries[name]
            if info.file_size > DEFLATE_LIMIT * (info.compress_size + 1):
                raise CloudFileError(f"is damaged: {name!r} cannot be as large as it promises")
            with archive.open(info) as file:
                return read_array(file, info.file_size)

        cloud = bare_cloud(load(key), attributes)
        others = [name for name in entries if name not in (key, "crs", "sensor_origin")]
        loaded = {name: load(name) for name in others} if attributes else {}
        fitting = {n: v for n, v in loaded.items() if v.dtype.kind in "biuf" and v.ndim and len(v) == len(cloud)}
        cloud.attributes |= fitting
        cloud.left_out = tuple(f"array {name!r}" for name in loaded if name not in fitting)
        cloud.crs = str(load("crs")) if "crs" in entries else None
        if "sensor_origin" in entries:
            cloud.sensor_origin = load("sensor_origin").astype(np.float64).reshape(3)
    return cloud


def read_array(file: Any, size: int) -> np.ndarray:
    """One .npy, after a look whether ``size`` bytes can hold what its header promises."""
    read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)[0]
    if version not in read_header:
        raise CloudFileError(f"is a .npy of version {version}, save it again with numpy.save")
    shape, _, dtype = read_header[version](file)
    if dtype.hasobject:
        raise CloudFileError("holds Python objects, save an array of numbers")
    if math.prod(shape) * dtype.itemsize > size - file.tell() or min(shape, default=0) < 0:
        raise CloudFileError(f"promises an array of {shape} and is too short for it, it is truncated: copy it again")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def write(path: Path, cloud: PointCloud) -> list[str]:
    if path.suffix.lower() == ".npz":
        return write_npz(path, cloud)
    warnings = lost_context(cloud, ".npy")
    array = cloud.points
    if cloud.attributes and all(values.ndim == 1 for values in cloud.attributes.values()):
        # Only where reading it would give the columns the same names again
        wide = np.column_stack([cloud.points, *cloud.attributes.values()]).astype(np.float64)
        array = wide if list(bare_cloud(wide, True).attributes) == list(cloud.attributes) else array
    if array.shape[1] == 3 and cloud.attributes:
        warnings.append(f".npy cannot hold the attributes {', '.join(cloud.attributes)}: left out, .npz can")
    with path.open("wb") as file:
        np.save(file, array)
    return warnings


def write_npz(path: Path, cloud: PointCloud) -> list[str]:
    arrays: dict[str, Any] = {"points": cloud.points}
    if cloud.crs:
        arrays["crs"] = np.array(cloud.crs)
    if cloud.sensor_origin is not None:
        arrays["sensor_origin"] = cloud.sensor_origin
    warnings = []
    for name, values in cloud.attributes.items():
        free = f"{name}_" if name in OWN else name
        if free != name:
            warnings.append(f"attribute {name!r} is written as {free!r}")
        arrays[free] = values
    with path.open("wb") as file:
        np.savez(file, **arrays)
    return warnings
