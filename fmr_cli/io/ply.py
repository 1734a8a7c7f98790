"""PLY: ascii and binary of both byte orders, any properties. A file with faces is a mesh."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import (
    Lines,
    eight_bit_colors,
    flat_columns,
    read_table,
    storable,
    to_cloud,
    unique,
    write_records,
)
from fmr_cli.io.mesh import Mesh, fan

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
NAMES = {TYPES[name]: name for name in ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 1 << 20


@dataclass
class Property:
    name: str
    type: str  # numpy's name, without the byte order
    count_type: str | None = None  # of a list


@dataclass
class Element:
    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(p.count_type for p in self.properties)

    def dtype(self, order: str) -> np.dtype:
        return np.dtype([(p.name, order + p.type) for p in self.properties])

    def least_row(self, binary: bool) -> int:
        """The bytes one row takes at the very least; a list may be empty."""
        return sum(np.dtype(p.count_type or p.type).itemsize if binary else 2 for p in self.properties)


@dataclass
class Header:
    order: str
    elements: list[Element]
    comments: dict[str, str]
    lines: int


def read(path: Path, attributes: bool) -> PointCloud | Mesh:
    """The vertices of a PLY file; a Mesh where it has faces. List properties of vertices are named in ``left_out``."""
    with path.open("rb") as file:
        header = read_header(file)
        found: dict[str, dict[str, Any]] = {}
        left_out = []
        size = os.path.getsize(path)
        decoded = (line.decode("utf-8", errors="replace") for line in file)
        text = None if header.order else Lines(decoded, header.lines)
        for element in header.elements:
            left = size + 1 if text else size - file.tell()  # the last line of a text may lack its end
            if element.count * element.least_row(binary=text is None) > left:
                raise CloudFileError(
                    f"its header promises {element.count} of {element.name!r} and the file is too short for them, "
                    "it is truncated or damaged: copy it again"
                )
            if text:
                found[element.name] = read_text(text, element)
            elif element.has_lists:
                found[element.name] = read_lists(file, element, header.order)
            else:
                records = np.fromfile(file, element.dtype(header.order), element.count if element.properties else 0)
                found[element.name] = {name: records[name] for name in records.dtype.names or ()}
            if element.name not in ("vertex", "face"):
                left_out.append(f"element {element.name!r}")
            if {"vertex", "face"} <= set(found):
                break
    if "vertex" not in found:
        raise CloudFileError("has no element 'vertex', so no points")
    lists = [p.name for e in header.elements if e.name == "vertex" for p in e.properties if p.count_type]
    cloud = to_cloud({name: v for name, v in found["vertex"].items() if name not in lists}, attributes)
    cloud.left_out = (*(f"list property {name!r}" for name in lists), *left_out)
    cloud.crs = header.comments.get("crs")
    if "sensor_origin" in header.comments:
        origin = np.array(header.comments["sensor_origin"].split(), dtype=np.float64)
        cloud.sensor_origin = origin if origin.shape == (3,) and np.isfinite(origin).all() else None
    corners = found.get("face", {}).get("vertex_indices", found.get("face", {}).get("vertex_index"))
    if corners is None or len(corners) == 0:
        return cloud
    return Mesh(cloud, fan(corners))


def read_header(file: BinaryIO) -> Header:
    if file.readline(10).strip() != b"ply":
        raise CloudFileError("is not a PLY file (its first line is not 'ply')")
    order = None
    elements: list[Element] = []
    comments: dict[str, str] = {}
    number = 1
    while True:
        raw = file.readline(LONGEST_HEADER)
        number += 1
        if not raw.endswith(b"\n") or file.tell() > LONGEST_HEADER:
            raise CloudFileError("has a PLY header without an end, it is truncated: copy it again")
        line = raw.decode("utf-8", errors="replace").strip()
        words = line.split()
        try:
            match words:
                case ["end_header"]:
                    break
                case ["comment", ("crs" | "sensor_origin") as key, *_]:
                    comments[key] = line.split(maxsplit=2)[2] if len(words) > 2 else ""
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", kind, _]:
                    order = ORDERS[kind]
                case ["element", name, count] if count.isascii() and count.isdigit():
                    elements.append(Element(name, int(count)))
                case ["property", "list", count_type, kind, name] if TYPES[count_type][0] in "iu":
                    elements[-1].properties.append(Property(name, TYPES[kind], TYPES[count_type]))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, TYPES[kind]))
                case _:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise CloudFileError(f"has a damaged PLY header: line {number} is {line[:60]!r}") from None
    if order is None:
        raise CloudFileError("has a PLY header without a 'format' line")
    for element in elements:
        for prop, name in zip(element.properties, unique([p.name for p in element.properties]), strict=True):
            prop.name = name
    return Header(order, elements, comments, number)


def read_text(lines: Lines, element: Element) -> dict[str, Any]:
    """One element of an ascii file, one row a line; lists as tuples."""
    if not element.has_lists:
        if not element.properties:
            return {}
        records = read_table(lines, element.dtype(""), element.count)
        return {p.name: records[p.name] for p in element.properties}
    columns: dict[str, list] = {p.name: [] for p in element.properties}
    rows = 0
    for line in islice(lines, element.count):
        words = iter(line.split())
        try:
            for p in element.properties:
                number = float if p.type[0] == "f" else int
                if p.count_type:
                    columns[p.name].append(tuple(number(next(words)) for _ in range(int(next(words)))))
                else:
                    columns[p.name].append(number(next(words)))
        except (ValueError, StopIteration, RuntimeError):
            raise CloudFileError(f"line {lines.number}: is no {element.name!r}: {line.strip()[:60]!r}") from None
        rows += 1
    if rows < element.count:
        raise CloudFileError(f"promises {element.count} of {element.name!r} and ends after {rows}: copy it again")
    return finish(element, columns)


def read_lists(file: BinaryIO, element: Element, order: str) -> dict[str, Any]:
    """One element with list properties of a binary file; leaves the file at its end."""
    start = file.tell()
    data = file.read()
    short = CloudFileError(f"ends within its {element.name!r} lists, it is truncated or damaged: copy it again")
    columns: dict[str, Any] = {p.name: [] for p in element.properties}
    position = 0
    structs = {p.name: struct.Struct(order + np.dtype(p.type).char) for p in element.properties}
    counts = {p.name: struct.Struct(order + np.dtype(p.count_type).char) for p in element.properties if p.count_type}

    def row_layout(at: int) -> np.dtype:
        """The dtype of the row at a position, its lists as long as they are there."""
        layout: list[tuple] = []
        for p in element.properties:
            if p.count_type is None:
                layout.append((p.name, order + p.type))
                continue
            offset = at + np.dtype(layout).itemsize
            length = counts[p.name].unpack_from(data, offset)[0]
            layout += [(f"{p.name} count", order + p.count_type), (p.name, order + p.type, (length,))]
        return np.dtype(layout)

    try:
        if element.count:
            # Nearly every mesh has triangles only: if all rows look like the first, they are read at once.
            layout = row_layout(0)
            if element.count * layout.itemsize <= len(data):
                records = np.frombuffer(data, layout, element.count)
                if all((records[f"{name} count"] == records[name].shape[1]).all() for name in counts):
                    file.seek(start + element.count * layout.itemsize)
                    return {p.name: records[p.name] for p in element.properties}
        for _ in range(element.count):
            for p in element.properties:
                size = structs[p.name].size
                if p.count_type is None:
                    columns[p.name].append(structs[p.name].unpack_from(data, position)[0])
                    position += size
                    continue
                length = counts[p.name].unpack_from(data, position)[0]
                position += counts[p.name].size
                if length < 0 or position + length * size > len(data):
                    raise short
                columns[p.name].append(
                    struct.unpack_from(f"{order}{length}{structs[p.name].format[-1]}", data, position)
                )
                position += length * size
    except (struct.error, ValueError):
        raise short from None
    file.seek(start + position)
    return finish(element, columns)


def finish(element: Element, columns: dict[str, list]) -> dict[str, Any]:
    """Scalar columns as arrays of the declared type, list columns as they are."""
    return {
        p.name: columns[p.name] if p.count_type else np.array(columns[p.name], np.float64).astype(p.type)
        for p in element.properties
    }


def write(path: Path, cloud: PointCloud) -> list[str]:
    """Binary little endian, coordinates as double; what PLY cannot hold comes back as warnings."""
    columns, warnings = flat_columns(eight_bit_colors(cloud.attributes), split=True)
    for name, values in columns.items():
        columns[name] = storable(values, long_integers=False)
        if values.dtype.kind in "iu" and not (columns[name].astype(values.dtype) == values).all():
            warnings.append(f"PLY holds no 8-byte integers: {name} is rounded to double")
    dtype = np.dtype([(axis, "<f8") for axis in "xyz"] + [(name, "<" + v.dtype.str[1:]) for name, v in columns.items()])
    header = ["ply", "format binary_little_endian 1.0", "comment written by fmr"]
    if cloud.crs:
        header.append(f"comment crs {' '.join(cloud.crs.splitlines())}")
    if cloud.sensor_origin is not None:
        header.append("comment sensor_origin " + " ".join(repr(float(v)) for v in cloud.sensor_origin))
    header.append(f"element vertex {len(cloud)}")
    header += [f"property {NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        write_records(file, cloud, dtype, columns)
    return warnings
