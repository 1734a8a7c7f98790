"""NPY: (N, 3+) numbers, (3, N) too, or records with x, y, z. NPZ: `points` (N, 3), attributes, crs, sensor_origin."""

from __future__ import annotations

import math
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import (
    bare_cloud,
    bare_names,
    coordinates,
    lost_context,
    native,
    parted,
    refuse_degrees,
    refuse_poses,
    to_cloud,
)
from fmr_cli.io.stream import CHUNK, CloudStream, Column, Wanted

# Said of files that Python 2 has written, which are read all the same
warnings.filterwarnings("ignore", "Reading `.npy` or `.npz` file required additional header parsing", UserWarning)

DEFLATE_LIMIT = 1100  # zip cannot shrink data more than this many times
OWN = ("points", "crs", "sensor_origin", "file")  # names an attribute in an NPZ cannot have
# What others call the array of coordinates; the first that is there
KEYS = ("points", "xyz", "pts", "pos", "positions", "coords", "coordinates", "vertices", "verts", "point_cloud",
        "pointcloud", "pcd", "pc", "cloud", "data", "arr_0")  # fmt: skip
WIDEST = 16  # columns a point may have that have no names
HEAD = 200  # rows that are looked at to tell poses from points
FEWEST = 10  # points of a cloud: an array of fewer rows and more columns holds the points side by side


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    if path.suffix.lower() == ".npz":
        yield from read_npz(path, wanted.attributes)
        return
    with path.open("rb") as file:
        shape, fortran, dtype = header_of(file, path.stat().st_size)
        offset = file.tell()
    array: Any = np.empty(shape, dtype)
    if math.prod(shape):
        array = np.memmap(path, dtype, "r", offset, shape, "F" if fortran else "C")
    yield from clouds_of(array, wanted.attributes)


def clouds_of(array: np.ndarray, attributes: bool) -> Iterator[PointCloud]:
    """Numbers or records as clouds, some points at a time; at least one."""
    if array.dtype.names:
        array = array.reshape(-1)
        for start in range(0, max(len(array), 1), CHUNK):
            part = array[start : start + CHUNK]
            yield to_cloud({name: part[name] for name in array.dtype.names or ()}, attributes)
        return
    rows = as_rows(array)
    layout = None if rows is array else f"an array of {array.shape}, taken for {len(rows)} points"
    names = bare_names(np.asarray(rows[: 1 << 16, 3:]))
    for start in range(0, max(len(rows), 1), CHUNK):
        cloud = bare_cloud(np.asarray(rows[start : start + CHUNK]), names, attributes)
        cloud.layout = layout
        yield cloud


def as_rows(array: np.ndarray) -> np.ndarray:
    """(N, 3 + k) of whatever shape points are held in. Raises CloudFileError naming what else it may be."""
    if array.ndim > 2 and array.shape[0] == 1:  # a batch of one cloud
        return as_rows(array[0])
    shape = array.shape
    if array.dtype.kind not in "biuf":
        raise CloudFileError(f"holds an array of {array.dtype}, points need numbers")
    if len(shape) == 3 and shape[1:] in ((3, 4), (4, 4)):
        refuse_poses(array[:HEAD].reshape(-1, math.prod(shape[1:])))
    if len(shape) == 3 and shape[2] in (3, 4, 6, 7):
        return array.reshape(-1, shape[2])  # a range image, or a batch of clouds
    if len(shape) == 3 and shape[0] == 3:
        return array.reshape(3, -1).T
    if len(shape) != 2 or shape[1] < 3 > shape[0] or (min(shape) < 3 and shape[1] != 3):
        raise CloudFileError(f"holds an array of {shape}, points need (N, 3) numbers or more columns")
    refuse_poses(array[:HEAD])
    rows, columns = shape
    if rows < FEWEST <= columns:
        return array.T
    if columns > WIDEST:
        raise CloudFileError(
            f"holds an array of {shape}: so many columns no point has, is it a depth image, or features? "
            "Give the points as (N, 3)"
        )
    return array


def read_npz(path: Path, attributes: bool) -> Iterator[PointCloud]:
    with zipfile.ZipFile(path) as archive:
        entries = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

        def load(name: str) -> np.ndarray:
            info = entries[name]
            if info.file_size > DEFLATE_LIMIT * (info.compress_size + 1):
                raise CloudFileError(f"is damaged: {name!r} cannot be as large as it promises")
            with archive.open(info) as file:
                header_of(file, info.file_size)
                file.seek(0)
                return np.lib.format.read_array(file, allow_pickle=False)

        named = {name.lower(): name for name in reversed(entries)}
        key = next((named[key] for key in KEYS if key in named), None)
        key = next(iter(entries)) if key is None and len(entries) == 1 else key
        axes = coordinates(entries) if key is None else None
        refuse_degrees(entries)
        if key is None and axes is None:
            raise CloudFileError(
                f"has no array 'points' (N, 3) among {', '.join(entries) or 'nothing'}: save the one you mean as .npy"
            )
        if key is not None:
            cloud = joined_up(list(clouds_of(load(key), attributes)))
        else:
            cloud = to_cloud(
                {axis: load(name).reshape(-1) for axis, name in zip("xyz", axes or (), strict=True)}, False
            )
        others = [name for name in entries if name not in (key, *(axes or ()), "crs", "sensor_origin")]
        loaded = {name: load(name) for name in others} if attributes else {}
        fitting = {n: v for n, v in loaded.items() if v.dtype.kind in "biuf" and v.ndim and len(v) == len(cloud)}
        cloud.attributes |= {name: native(values) for name, values in parted(fitting).items()}
        cloud.left_out = tuple(f"array {name!r}" for name in loaded if name not in fitting)
        cloud.crs = str(load("crs")) if "crs" in entries else None
        if "sensor_origin" in entries:
            cloud.sensor_origin = load("sensor_origin").astype(np.float64).reshape(3)
    for start in range(0, max(len(cloud), 1), CHUNK):
        yield cloud.select(slice(start, start + CHUNK))


def joined_up(clouds: list[PointCloud]) -> PointCloud:
    return PointCloud(
        np.concatenate([c.points for c in clouds]),
        {name: np.concatenate([c.attributes[name] for c in clouds]) for name in clouds[0].attributes},
        layout=clouds[0].layout,
    )


def header_of(file: Any, size: int) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type of one .npy, after a look whether ``size`` bytes can hold what its header promises."""
    read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)[0]
    if version not in read_header:
        raise CloudFileError(f"is a .npy of version {version}: give its fields ASCII names and save it again")
    shape, fortran, dtype = read_header[version](file)
    if dtype.hasobject:
        raise CloudFileError("holds Python objects, save an array of numbers")
    if math.prod(shape) * dtype.itemsize > size - file.tell() or min(shape, default=0) < 0:
        raise CloudFileError(f"promises an array of {shape} and is too short for it, it is truncated: copy it again")
    return shape, fortran, dtype


def write(path: Path, stream: CloudStream) -> list[str]:
    if path.suffix.lower() == ".npz":
        return write_npz(path, stream)
    survey = stream.survey
    warnings = lost_context(survey.head, ".npy")
    names: list[str] = []
    if survey.columns and all(not c.shape and c.dtype.kind in "biuf" for c in survey.columns.values()):
        # Only where reading it would give the columns the same names again
        first = next(chunk for chunk in stream if len(chunk))
        wide = np.column_stack([*first.attributes.values()]).astype(np.float64)[: 1 << 16]
        names = [*survey.columns] if bare_names(wide) == [*survey.columns] else []
    if not names and survey.columns:
        warnings.append(f".npy cannot hold the attributes {', '.join(survey.columns)}: left out, .npz can")
    with path.open("wb") as file:
        write_header(file, (survey.count, 3 + len(names)), np.dtype("<f8"))
        for cloud in stream:
            rows = np.column_stack([cloud.points, *(cloud.attributes[name] for name in names)])
            file.write(np.ascontiguousarray(rows, "<f8").tobytes())
    return warnings


def write_header(file: Any, shape: tuple[int, ...], dtype: np.dtype) -> None:
    descr = np.lib.format.dtype_to_descr(dtype)
    np.lib.format.write_array_header_2_0(file, {"descr": descr, "fortran_order": False, "shape": shape})


def write_npz(path: Path, stream: CloudStream) -> list[str]:
    """Zip entries stand one after the other: what belongs to them waits in files without a name beside ``path``."""
    survey = stream.survey
    warnings = []
    names: dict[str, str] = {}
    for name in survey.columns:
        names[name] = f"{name}_" if name in OWN else name
        if names[name] != name:
            warnings.append(f"attribute {name!r} is written as {names[name]!r}")
    with ExitStack() as stack:
        waiting = {n: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for n in ("points", *names)}
        for cloud in stream:
            waiting["points"].write(cloud.points.tobytes())
            for name, column in survey.columns.items():
                waiting[name].write(np.ascontiguousarray(cloud.attributes[name], column.dtype).tobytes())
        with zipfile.ZipFile(path, "w") as archive:
            for name, file in waiting.items():
                own = survey.columns.get(name, Column(np.dtype("<f8"), (3,)))
                with archive.open(f"{names.get(name, name)}.npy", "w", force_zip64=True) as entry:
                    write_header(entry, (survey.count, *own.shape), own.dtype)
                    file.seek(0)
                    while block := file.read(1 << 24):
                        entry.write(block)
            for name, value in (("crs", survey.head.crs), ("sensor_origin", survey.head.sensor_origin)):
                if value is not None and len(value):
                    with archive.open(f"{name}.npy", "w") as entry:
                        np.lib.format.write_array(entry, np.asarray(value))
    return warnings
