"""E57 (ASTM E2807) by libe57: all scans with their poses, names and fields, cartesian or spherical; read and written.

Points are in the file's common frame; `PointCloud.T_file_scan` says where each scan stood, and is written again.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import Field, fields_of, lost_context, storable, unique
from fmr_cli.io.files import reason
from fmr_cli.io.parts import ScanPart, choose, proper
from fmr_cli.io.stream import CHUNK, COLORS, CloudStream, Survey, Wanted

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
INVALID = ("cartesianInvalidState", "sphericalInvalidState")
# The standard's name -> the attribute's; others keep theirs, without the prefix of an extension
NAMES = {
    "colorRed": "red", "colorGreen": "green", "colorBlue": "blue", "rowIndex": "row", "columnIndex": "column",
    "returnIndex": "return_number", "returnCount": "number_of_returns", "timeStamp": "timestamp",
    "isIntensityInvalid": "intensity_invalid", "isColorInvalid": "color_invalid", "isTimeStampInvalid": "time_invalid",
    "nor:normalX": "nx", "nor:normalY": "ny", "nor:normalZ": "nz",
}  # fmt: skip
STANDARD = {new: old for old, new in NAMES.items()} | {"intensity": "intensity"}
LONG = np.dtype(np.longlong)  # 8 bytes for libe57, which takes numpy's int64 (C's long) for 4
NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
OWN_URI = "urn:fmr:attributes"  # of fields that the standard does not know


def library() -> Any:
    try:
        from pye57 import libe57
    except ImportError:
        raise CloudFileError(
            "needs the library pye57, for x86-64: pip install 'fmr-cli[e57]', or export it as .las or .ply"
        ) from None
    return libe57


def scans(path: Path) -> list[ScanPart]:
    """Name, pose and number of points of each scan."""
    with opened(library(), path) as file:
        return [part_of(scan, k) for k, scan in enumerate(scan_nodes(file))]


@contextmanager
def opened(lib: Any, path: Path) -> Iterator[Any]:
    """The file, closed at the end. Raises CloudFileError for what libe57 says of it, of which the first sentence."""
    file = None
    try:
        file = lib.ImageFile(str(path), "r")
        yield file
    except CloudFileError:
        raise
    except Exception as error:
        what = reason(error).partition(" (Error")[0].partition(" ****")[0]
        raise CloudFileError(f"is damaged or truncated ({what}): copy it again") from error
    finally:
        if file is not None:
            file.close()


def scan_nodes(file: Any) -> list[Any]:
    root = file.root()
    if not root.isDefined("data3D"):
        return []
    return list(root["data3D"])


def part_of(scan: Any, number: int) -> ScanPart:
    name = scan["name"].value() if scan.isDefined("name") else ""
    return ScanPart(name or f"scan {number + 1}", pose_of(scan), scan["points"].childCount())


def pose_of(scan: Any) -> np.ndarray:
    """T_file_scan (4x4); the identity where the scan has no pose."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    if not scan.isDefined("pose"):
        return T
    pose = scan["pose"]
    if pose.isDefined("rotation"):
        q = [pose["rotation"][axis].value() for axis in "xyzw"]
        if not np.isfinite(q).all() or not np.linalg.norm(q) > 0:
            raise CloudFileError("has a scan whose pose is no rotation, it is damaged")
        T[:3, :3] = Rotation.from_quat(q).as_matrix()
    if pose.isDefined("translation"):
        T[:3, 3] = [pose["translation"][axis].value() for axis in "xyz"]
    return T


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    """All scans after each other, or the one that is wanted. Of several, ``scan`` numbers them from 1."""
    lib = library()
    with opened(lib, path) as file:
        nodes = scan_nodes(file)
        parts = [part_of(scan, k) for k, scan in enumerate(nodes)]
        if not parts:
            raise CloudFileError("holds no scan")
        chosen = choose(parts, wanted.part)
        fields = {k: fields_in(lib, nodes[k]) for k in chosen}
        kinds: dict[str, np.dtype] = {}
        for own in fields.values() if wanted.attributes else ():
            for name, (_, dtype) in own.items():
                kinds[name] = np.promote_types(kinds[name], dtype) if name in kinds else dtype
        root = file.root()
        left_out = ["2D images"] if root.isDefined("images2D") and root["images2D"].childCount() else []
        crs = root["coordinateMetadata"].value() if root.isDefined("coordinateMetadata") else ""
        for k in chosen:
            part = parts[k]
            for xyz, values in points_of(lib, file, nodes[k], fields[k] if wanted.attributes else {}):
                kept = {}
                for name, dtype in kinds.items():
                    empty = np.nan if dtype.kind == "f" else 0
                    kept[name] = values[name].astype(dtype) if name in values else np.full(len(xyz), empty, dtype)
                if len(chosen) > 1 and wanted.attributes:
                    kept["scan"] = np.full(len(xyz), k + 1, np.uint16)
                yield PointCloud(
                    transform_points(part.T_file_scan, xyz), kept, crs=crs or None, left_out=tuple(left_out),
                    sensor_origin=part.T_file_scan[:3, 3], scan=part.name, T_file_scan=part.T_file_scan,
                )  # fmt: skip


def fields_in(lib: Any, scan: Any) -> dict[str, tuple[str, np.dtype]]:
    """Attribute -> (the file's name, its type); coordinates and their states are none."""
    prototype = lib.StructureNode(scan["points"].prototype())
    names = [prototype.get(i).elementName() for i in range(prototype.childCount())]
    own = [name for name in names if name not in (*CARTESIAN, *SPHERICAL, *INVALID)]
    given = unique(NAMES.get(name, name.split(":")[-1]) for name in own)
    return {new: (old, type_of(lib, prototype, old)) for new, old in zip(given, own, strict=True)}


def type_of(lib: Any, prototype: Any, name: str) -> np.dtype:
    """The smallest type that holds all that the field may."""
    node = prototype.get(name)
    if node.type() == lib.NodeType.E57_INTEGER:
        low, high = lib.IntegerNode(node).minimum(), lib.IntegerNode(node).maximum()
        return np.promote_types(np.min_scalar_type(low), np.min_scalar_type(high)) if high < 1 << 53 else np.dtype("i8")
    single = node.type() == lib.NodeType.E57_FLOAT and lib.FloatNode(node).precision() == lib.E57_SINGLE
    return np.dtype(np.float32 if single else np.float64)


def points_of(
    lib: Any, file: Any, scan: Any, fields: dict[str, tuple[str, np.dtype]]
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Coordinates (n, 3) in the scan's own frame, NaN where invalid, and attributes, some points at a time."""
    points = scan["points"]
    prototype = lib.StructureNode(points.prototype())
    cartesian = all(prototype.isDefined(name) for name in CARTESIAN)
    if not cartesian and not all(prototype.isDefined(name) for name in SPHERICAL):
        raise CloudFileError("has a scan without coordinates")
    axes, state = (CARTESIAN, INVALID[0]) if cartesian else (SPHERICAL, INVALID[1])
    count = min(CHUNK, max(points.childCount(), 1))
    arrays = {name: np.empty(count) for name in axes}
    if prototype.isDefined(state):
        arrays[state] = np.empty(count, np.int8)
    arrays |= {old: np.empty(count, dtype if dtype.kind == "f" else LONG) for old, dtype in fields.values()}
    buffers = lib.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(lib.SourceDestBuffer(file, name, array, count, True, True))
    reader = points.reader(buffers)
    try:
        while n := reader.read():
            a, b, c = (arrays[name][:n] for name in axes)
            if not cartesian:
                a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
            xyz = np.stack([a, b, c], 1)
            if state in arrays:
                xyz[arrays[state][:n] != 0] = np.nan
            yield xyz, {new: arrays[old][:n].astype(dtype) for new, (old, dtype) in fields.items()}
    finally:
        reader.close()


def write(path: Path, stream: CloudStream) -> list[str]:
    """Each scan of the stream with its pose, or all points as one; all in their own precision."""
    lib = library()
    survey = stream.survey
    fields, warnings = fields_of(survey, split=True, eight_bit=True)
    fields = [f for f in fields if f.of != "scan" or survey.head.scan is not None]
    for column in fields:
        if rounded := storable(column, survey.columns[column.of], long_integers=True):
            warnings.append(rounded)
    file = lib.ImageFile(str(path), "w")
    try:
        prepare_file(lib, file, survey)
        sink = None
        scan: object = sink
        for cloud in stream:
            if sink is None or cloud.scan != scan:
                if sink is not None:
                    sink.close()
                sink, scan = ScanSink(lib, file, cloud, survey, fields), cloud.scan
            sink.write(cloud)
        if sink is not None:
            sink.close()
    finally:
        file.close()
    return warnings + [w for w in lost_context(survey.head, path.suffix) if "sensor" in w and survey.head.scan is None]


def prepare_file(lib: Any, file: Any, survey: Survey) -> None:
    """The root of a new file."""
    root = file.root()
    for prefix, uri in (("", lib.E57_V1_0_URI), ("nor", NORMALS_URI), ("fmr", OWN_URI)):
        file.extensionsAdd(prefix, uri)
    root.set("formatName", lib.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", lib.StringNode(file, f"{{{uuid.uuid4()}}}"))
    root.set("versionMajor", lib.IntegerNode(file, lib.E57_FORMAT_MAJOR))
    root.set("versionMinor", lib.IntegerNode(file, lib.E57_FORMAT_MINOR))
    root.set("coordinateMetadata", lib.StringNode(file, survey.head.crs or ""))
    root.set("data3D", lib.VectorNode(file, True))


class ScanSink:
    """One scan of a file that is written: its points in its own frame."""

    def __init__(self, lib: Any, file: Any, first: PointCloud, survey: Survey, fields: list[Field]) -> None:
        from scipy.spatial.transform import Rotation

        self.fields = fields
        node = lib.StructureNode(file)
        node.set("guid", lib.StringNode(file, f"{{{uuid.uuid4()}}}"))
        node.set("name", lib.StringNode(file, first.scan or ""))
        self.T_scan_file = np.eye(4)
        if first.T_file_scan is not None:
            T = proper(first.T_file_scan)
            T[:3, :3] /= np.cbrt(np.linalg.det(T[:3, :3]))  # a pose has no scale: the points keep it
            self.T_scan_file = np.linalg.inv(T)
            pose, rotation, translation = (lib.StructureNode(file) for _ in range(3))
            for axis, value in zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat(), strict=True):
                rotation.set(axis, lib.FloatNode(file, float(value)))
            for axis, value in zip("xyz", T[:3, 3], strict=True):
                translation.set(axis, lib.FloatNode(file, float(value)))
            pose.set("rotation", rotation)
            pose.set("translation", translation)
            node.set("pose", pose)
        prototype = lib.StructureNode(file)
        for name in CARTESIAN:
            prototype.set(name, lib.FloatNode(file, 0.0, lib.E57_DOUBLE))
        self.arrays = {name: np.empty(CHUNK) for name in CARTESIAN}
        self.names = {f.name: STANDARD.get(f.of, f"fmr:{f.name}") for f in fields}
        for f in fields:
            column, name = survey.columns[f.of], self.names[f.name]
            if f.dtype.kind == "f":
                precision = lib.E57_SINGLE if f.dtype.itemsize == 4 else lib.E57_DOUBLE
                prototype.set(name, lib.FloatNode(file, 0.0, precision))
                self.arrays[name] = np.empty(CHUNK, f.dtype)
            else:
                low, high = int(min(column.low // f.divide, 0)), int(max(column.high // f.divide, 0))
                if f.of in COLORS:
                    high = max(high, 255)
                prototype.set(name, lib.IntegerNode(file, 0, low, high))
                self.arrays[name] = np.empty(CHUNK, LONG)
        points = lib.CompressedVectorNode(file, prototype, lib.VectorNode(file, True))
        node.set("points", points)
        file.root()["data3D"].append(node)
        buffers = lib.VectorSourceDestBuffer()
        for name, array in self.arrays.items():
            buffers.append(lib.SourceDestBuffer(file, name, array, CHUNK, True, True))
        self.writer = points.writer(buffers)

    def write(self, cloud: PointCloud) -> None:
        local = transform_points(self.T_scan_file, cloud.points)
        for start in range(0, len(cloud), CHUNK):
            part = cloud.select(slice(start, start + CHUNK))
            n = len(part)
            for i, name in enumerate(CARTESIAN):
                self.arrays[name][:n] = local[start : start + n, i]
            for f in self.fields:
                self.arrays[self.names[f.name]][:n] = f.values(part)
            if n:
                self.writer.write(n)

    def close(self) -> None:
        self.writer.close()
