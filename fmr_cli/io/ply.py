"""PLY: ascii and binary of both byte orders, any properties. A file with faces is a mesh."""

from __future__ import annotations

import codecs
import os
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from io import TextIOWrapper
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import fields_of, storable, to_cloud, unique, write_records
from fmr_cli.io.mesh import Mesh, fan
from fmr_cli.io.stream import CHUNK, COLORS, CloudStream, Wanted, collect
from fmr_cli.io.table import AMONG_POINTS, MOST_COLUMNS, Lines, beyond, read_rows

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"longlong": "i8", "ulonglong": "u8", "half": "f2", "float16": "f2"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
NAMES = {TYPES[name]: name for name in ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
KEYWORDS = ("ply", "format", "comment", "obj_info", "element", "property", "end_header")
ELEMENTS = {**dict.fromkeys(("vertex", "vertices", "point", "points"), "vertex"), "face": "face", "faces": "face"}
LONGEST_HEADER = 1 << 20


@dataclass
class Property:
    """A property of an element, as the header declares it."""

    name: str
    type: str  # numpy's name, without the byte order
    count_type: str | None = None  # of a list


@dataclass
class Element:
    """An element, as the header declares it."""

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
    """What the head of the file says."""

    order: str
    elements: list[Element]
    comments: dict[str, str]
    lines: int


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud | Mesh]:
    """The vertices of a PLY file; a Mesh where it has faces. List properties of vertices are named in ``left_out``."""
    size = os.path.getsize(path)
    with ExitStack() as stack:
        file = stack.enter_context(path.open("rb"))
        header = read_header(file)
        names = [e.name for e in header.elements]
        if "vertex" not in names:
            raise CloudFileError("has no element 'vertex', so no points")
        faces = next((e for e in header.elements if e.name == "face" and e.count), None)
        context = context_of(header)
        text = None
        if not header.order:
            lines = stack.enter_context(TextIOWrapper(file, "utf-8", errors="replace"))
            text = Lines(lines, header.lines, AMONG_POINTS)
        corners = None
        vertices: list[PointCloud] = []
        colors: dict[str, np.ndarray] = {}
        for element in header.elements:
            check_length(element, text is None, size - (0 if text else file.tell()))
            if element.name == "vertex":
                for columns in columns_of(file, text, element, header.order):
                    cloud = to_cloud(columns, wanted.attributes)
                    cloud = replace(cloud, **context)
                    if faces is None:
                        yield cloud
                    else:
                        vertices.append(cloud)
                if faces is None:
                    later = header.elements[header.elements.index(element) + 1 :]
                    if text and (notes := beyond(text, element.count, sum(e.count for e in later))):
                        yield replace(cloud.select(slice(0)), notes=notes)
                    return
            else:
                columns = join_columns(columns_of(file, text, element, header.order, lists=element.name == "face"))
                if element is faces:
                    corners = columns.get("vertex_indices", columns.get("vertex_index"))
                    colors = {c: columns[c] for c in COLORS if c in columns}
            if corners is not None and vertices:
                break
        mesh = collect(vertices)
        if corners is None or len(corners) == 0:
            yield mesh
        else:
            colors = {} if {*COLORS} & {*mesh.attributes} or not wanted.attributes else colors
            yield Mesh(mesh, *fan(corners, colors))


def context_of(header: Header) -> dict[str, Any]:
    """What the header says of the whole cloud."""
    vertex = next(e for e in header.elements if e.name == "vertex")
    lists = [f"list property {p.name!r}" for p in vertex.properties if p.count_type]
    others = [f"element {e.name!r}" for e in header.elements if e.name not in ("vertex", "face")]
    known = ("vertex_indices", "vertex_index", *(() if {*COLORS} & {p.name for p in vertex.properties} else COLORS))
    faces = [p.name for e in header.elements if e.name == "face" and e.count for p in e.properties]
    lists += [f"property {name!r} of the faces" for name in faces if name not in known]
    origin = np.array(header.comments.get("sensor_origin", "nan").split(), dtype=np.float64)
    return {
        "left_out": (*lists, *others),
        "crs": header.comments.get("crs"),
        "sensor_origin": origin if origin.shape == (3,) and np.isfinite(origin).all() else None,
    }


def check_length(element: Element, binary: bool, left: int) -> None:
    """Raises CloudFileError where what is left of the file is too short for the element."""
    if element.count * element.least_row(binary) > left + (not binary):  # the last line of a text may lack its end
        raise CloudFileError(
            f"its header promises {element.count} of {element.name!r} and the file is too short for them, "
            "it is truncated or damaged: copy it again"
        )


def columns_of(
    file: BinaryIO, text: Lines | None, element: Element, order: str, lists: bool = False
) -> Iterator[dict[str, Any]]:
    """An element's properties as columns, some rows at a time; leaves the file at its end. lists: those too."""
    names = [p.name for p in element.properties if lists or not p.count_type]
    if not element.properties:
        yield {}
    elif element.has_lists:
        columns = read_text_lists(text, element) if text else read_lists(file, element, order)
        yield {name: columns[name] for name in names}
    elif text:
        for records in chain([np.empty(0, element.dtype(""))], read_rows(text, element.dtype(""), element.count)):
            yield {name: records[name] for name in names}
    else:
        for start in range(0, max(element.count, 1), CHUNK):
            records = np.fromfile(file, element.dtype(order), min(CHUNK, element.count - start))
            yield {name: records[name] for name in names}


def join_columns(parts: Iterator[dict[str, Any]]) -> dict[str, Any]:
    first, *rest = parts
    return first if not rest else {name: np.concatenate([first[name], *(p[name] for p in rest)]) for name in first}


def header_lines(file: BinaryIO) -> Iterator[str]:
    """The lines of a header, whichever end they have: LF, CR LF or CR. Leaves the file after the last one taken."""
    file.seek(0)
    start = file.read(LONGEST_HEADER)
    end = min((at for at in (start.find(b"\n"), start.find(b"\r")) if at >= 0), default=-1)
    if end < 0:
        raise CloudFileError("has a header without an end, it is truncated: copy it again")
    stop = b"\n" if start[end : end + 1] == b"\n" else b"\r\n" if start[end : end + 2] == b"\r\n" else b"\r"
    place = 0
    while (found := start.find(stop, place)) >= 0:
        file.seek(found + len(stop))
        yield start[place:found].decode("utf-8", errors="replace").strip()
        place = found + len(stop)
    raise CloudFileError("has a PLY header without an end, it is truncated: copy it again")


def read_header(file: BinaryIO) -> Header:
    if not file.read(6).removeprefix(codecs.BOM_UTF8).lower().startswith(b"ply"):
        raise CloudFileError("is not a PLY file (its first line is not 'ply')")
    order = None
    elements: list[Element] = []
    comments: dict[str, str] = {}
    number = 0
    in_comment = False
    for number, line in enumerate(header_lines(file), 1):
        words = line.split()
        keyword = words[0].lower() if words else ""
        try:
            match [keyword, *words[1:]]:
                case ["end_header", *_]:
                    break
                case ["ply" | "\ufeffply"] | [""]:
                    continue
                case ["comment", ("crs" | "sensor_origin") as key, *_]:
                    comments[key] = line.split(maxsplit=2)[2] if len(words) > 2 else ""
                case ["comment" | "obj_info", *_]:
                    in_comment = True
                    continue
                case ["format", kind, *_]:
                    order = ORDERS[kind.lower()]
                case ["element", name, count] if count.isascii() and count.isdigit():
                    elements.append(Element(ELEMENTS.get(name.lower(), name), int(count)))
                case ["property", "list" | "LIST", count_type, kind, name] if TYPES[count_type.lower()][0] in "iu":
                    elements[-1].properties.append(Property(name, TYPES[kind.lower()], TYPES[count_type.lower()]))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, TYPES[kind.lower()]))
                case _ if in_comment and keyword not in KEYWORDS:
                    continue  # a comment of several lines
                case _:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise CloudFileError(f"has a damaged PLY header: line {number} is {line[:60]!r}") from None
        in_comment = False
    if order is None:
        raise CloudFileError("has a PLY header without a 'format' line")
    for element in elements:
        if len(element.properties) > MOST_COLUMNS:
            raise CloudFileError(
                f"declares {len(element.properties)} properties of a {element.name}, no point has so many"
            )
        for prop, name in zip(element.properties, unique([p.name for p in element.properties]), strict=True):
            prop.name = name
    return Header(order, elements, comments, number)


def read_text_lists(lines: Lines, element: Element) -> dict[str, Any]:
    """One element of an ascii file with lists, one row a line; the lists as tuples."""
    columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
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
        layout: list[tuple[Any, ...]] = []
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


def finish(element: Element, columns: dict[str, list[Any]]) -> dict[str, Any]:
    """Scalar columns as arrays of the declared type, list columns as they are."""
    return {
        p.name: columns[p.name] if p.count_type else np.array(columns[p.name], np.float64).astype(p.type)
        for p in element.properties
    }


def write(path: Path, stream: CloudStream) -> list[str]:
    """Binary little endian, coordinates as double; what PLY cannot hold comes back as warnings."""
    survey = stream.survey
    fields, warnings = fields_of(survey, split=True, eight_bit=True)
    for column in fields:
        if rounded := storable(column, survey.columns[column.of], long_integers=False):
            warnings.append(f"PLY holds no 8-byte integers: {rounded}")
    dtype = np.dtype([(axis, "<f8") for axis in "xyz"] + [(f.name, "<" + f.dtype.str[1:]) for f in fields])
    header = ["ply", "format binary_little_endian 1.0", "comment written by fmr"]
    if survey.head.crs:
        header.append(f"comment crs {' '.join(survey.head.crs.splitlines())}")
    if survey.head.sensor_origin is not None:
        header.append("comment sensor_origin " + " ".join(repr(float(v)) for v in survey.head.sensor_origin))
    header.append(f"element vertex {survey.count}")
    header += [f"property {NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        write_records(file, stream, dtype, fields)
    return warnings
