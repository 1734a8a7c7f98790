"""PCD: ascii, binary and binary_compressed, of every version.

Packed `rgb` becomes red, green, blue; VIEWPOINT the sensor's place. A compressed file is one block, which has to be in
memory whole.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import Field, fields_of, storable, to_cloud, unique
from fmr_cli.io.stream import CHUNK, COLORS, CloudStream, Survey, Wanted
from fmr_cli.io.table import AMONG_POINTS, MOST_COLUMNS, Lines, beyond, read_rows

LONGEST_HEADER = 1 << 20
LINE_END = re.compile(rb"\r\n|\n|\r")
PCL_NAMES = {f"n{axis}": f"normal_{axis}" for axis in "xyz"}
RESTS = ("x_rest", "y_rest", "z_rest")
NOTABLE = 1e-5  # a rounding that is worth a warning, as a share of the cloud's extent
LZF_LIMIT = 90  # LZF cannot shrink data more than this many times


@dataclass
class Header:
    """What the head of the file says."""

    fields: np.dtype  # packed, in the file's order; padding fields are called _, __2, ...
    points: int
    viewpoint: tuple[float, ...]  # x y z and a quaternion w x y z; empty where the file has none
    encoding: str
    lines: int
    crs: str | None


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    with ExitStack() as stack:
        file = stack.enter_context(path.open("rb"))
        header = read_header(file)
        left = os.path.getsize(path) - file.tell()
        width = header.fields.itemsize
        least = {
            "ascii": 2 * len(flat_names(header.fields)) * header.points - 1,
            "binary": width * header.points,
            "binary_compressed": width * header.points // LZF_LIMIT,
        }
        if header.encoding not in least:
            raise CloudFileError(f"has an unknown PCD encoding {header.encoding!r}")
        if least[header.encoding] > left:
            raise CloudFileError(
                f"its header promises {header.points} points and the file is too short for them, "
                "it is truncated or damaged: copy it again"
            )
        text = None
        if header.encoding == "ascii":
            lines = stack.enter_context(TextIOWrapper(file, "utf-8", errors="replace"))
            text = Lines(lines, header.lines, AMONG_POINTS)
        for records in records_of(file, text, header):
            cloud = cloud_of(records, header, wanted.attributes)
            yield cloud
        if text and (notes := beyond(text, header.points)):
            yield replace(cloud.select(slice(0)), notes=notes)


def records_of(file: BinaryIO, text: Lines | None, header: Header) -> Iterator[np.ndarray]:
    """The points as records of ``header.fields``, some at a time; at least one, which may be empty."""
    if header.points == 0:
        yield np.empty(0, header.fields)
    elif text:
        for rows in read_rows(text, np.dtype(flat_names(header.fields)), header.points):
            yield np.frombuffer(rows.tobytes(), header.fields, len(rows))
    elif header.encoding == "binary":
        for start in range(0, header.points, CHUNK):
            yield np.fromfile(file, header.fields, min(CHUNK, header.points - start))
    else:
        records = read_compressed(file, header)
        for start in range(0, header.points, CHUNK):
            yield records[start : start + CHUNK]


def cloud_of(records: np.ndarray, header: Header, attributes: bool) -> PointCloud:
    columns = {name: records[name] for name in header.fields.names or () if not re.fullmatch(r"_(_\d+)?", name)}
    if {*"xyz", *RESTS} <= set(columns):
        columns |= {axis: columns[axis] + columns.pop(rest) for axis, rest in zip("xyz", RESTS, strict=True)}
    cloud = to_cloud(unpack_colors(columns) if attributes else columns, attributes)
    if header.viewpoint and np.isfinite(header.viewpoint).all():
        cloud.sensor_origin = np.array(header.viewpoint[:3])
        if header.viewpoint[3:] != (1, 0, 0, 0):
            cloud.left_out = ("the sensor's orientation",)
    cloud.crs = header.crs
    return cloud


def read_header(file: BinaryIO) -> Header:
    """Keys in capitals or not, each with its values; COLUMNS for FIELDS, and no SIZE and TYPE, as before version 0.6.

    Lines end in LF, CR LF or CR; their words are parted by blanks, tabs or commas.
    """
    start = file.read(LONGEST_HEADER)
    words: dict[str, list[str]] = {}
    crs = None
    number = place = 0
    while "DATA" not in words:
        end = LINE_END.search(start, place)
        if end is None:
            raise CloudFileError("has no complete PCD header, it is truncated or no PCD file")
        line = start[place : end.start()].decode("utf-8", errors="replace").strip()
        place, number = end.end(), number + 1
        if line.startswith("# crs "):
            crs = line[6:]
        elif line and not line.startswith("#"):
            key, *values = line.replace(",", " ").split()
            words[key.upper()] = values
    file.seek(place)
    try:
        names = words.get("FIELDS") or words["COLUMNS"]
        sizes, kinds = words.get("SIZE", ["4"] * len(names)), words.get("TYPE", ["F"] * len(names))
        counts = [int(c) for c in words.get("COUNT", ["1"] * len(names))]
        if not len(names) == len(sizes) == len(kinds) == len(counts) or min(counts) < 0 or max(counts) > 1 << 20:
            raise ValueError
        columns = sum(counts) if words["DATA"][0].lower() == "ascii" else len(names)
        if columns > MOST_COLUMNS:
            raise CloudFileError(f"declares {columns} values of a point, no point has so many")
        types = [f"{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True)]
        if any(kind not in ("f4", "f8", *(k + s for k in "iu" for s in "1248")) for kind in types):
            raise ValueError
        # COUNT 0 takes no place in the records: such a field has no values
        layout = [
            (n, f"<{t}") if c == 1 else (n, f"<{t}", (c,))
            for n, t, c in zip(unique(names), types, counts, strict=True) if c
        ]  # fmt: skip
        size = [int(words[key][0]) for key in ("WIDTH", "HEIGHT")] if "WIDTH" in words else [int(words["POINTS"][0]), 1]
        points = int(words["POINTS"][0]) if "POINTS" in words else size[0] * size[1]
        viewpoint = tuple(float(v) for v in words.get("VIEWPOINT", []))
        if min(points, *size) < 0 or points != size[0] * size[1] or len(viewpoint) not in (0, 7):
            raise ValueError
        return Header(np.dtype(layout), points, viewpoint, words["DATA"][0].lower(), number, crs)
    except (KeyError, IndexError, ValueError):
        raise CloudFileError("has a damaged PCD header (FIELDS, SIZE, TYPE, COUNT, WIDTH, HEIGHT, POINTS)") from None


def flat_names(fields: np.dtype) -> list[tuple[str, np.dtype]]:
    """Every number of a row with its type; a field of three is three of them."""
    return [
        (f"{name}/{k}", fields[name].base)
        for name in fields.names or ()
        for k in range(int(np.prod(fields[name].shape, dtype=int)))
    ]


def read_compressed(file: BinaryIO, header: Header) -> np.ndarray:
    """binary_compressed: two sizes, then the LZF-packed fields, one whole column after the other."""
    import lzf

    damaged = CloudFileError("has damaged compressed data, it is truncated: copy it again")
    sizes = file.read(8)
    total = header.fields.itemsize * header.points
    if len(sizes) < 8:
        raise damaged
    packed, unpacked = struct.unpack("<II", sizes)
    data = file.read()[:packed]
    if len(data) < packed or unpacked != total:
        raise damaged
    plain = lzf.decompress(data, unpacked) if unpacked else b""
    if plain is None or len(plain) != unpacked:
        raise damaged
    records = np.empty(header.points, header.fields)
    start = 0
    for name in header.fields.names or ():
        column = np.frombuffer(plain, header.fields[name].base, records[name].size, start)
        records[name] = column.reshape(records[name].shape)
        start += records[name].nbytes
    return records


def unpack_colors(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Replaces packed `rgb` (0x00RRGGBB, mostly as the bits of a float) and `rgba` by single 8-bit channels."""
    result = {}
    for name, values in columns.items():
        if name not in ("rgb", "rgba") or values.dtype.itemsize != 4 or values.ndim != 1 or "red" in columns:
            result[name] = values
            continue
        packed = np.ascontiguousarray(values).view("<u4")
        channels = {"red": 16, "green": 8, "blue": 0} | ({"alpha": 24} if name == "rgba" else {})
        result.update({color: (packed >> shift & 255).astype(np.uint8) for color, shift in channels.items()})
    return result


def write(path: Path, stream: CloudStream) -> list[str]:
    """DATA binary; 8-bit colours packed, everything else in its own type.

    PCL and Open3D know float32 coordinates only (Open3D takes F 8 for zeros), so x y z are F 4; where that rounds them,
    what is missing stands in the fields x_rest y_rest z_rest, and `read` adds it again.
    """
    survey = stream.survey
    fields, warnings = fields_of(survey, split=False, eight_bit=True)
    packed, fields = pack_colors(fields)
    for field in fields:
        storable(field, survey.columns[field.of], long_integers=True)
    coordinate = "<f4" if np.isfinite(survey.rest) else "<f8"
    rests = RESTS if coordinate == "<f4" and survey.rest > 0 else ()
    if rests and survey.rest > NOTABLE * (survey.high - survey.low).max():
        warnings.append(f"most readers of PCD take float32 only and will round coordinates by up to {survey.rest:.2g}")
    layout: list[tuple[Any, ...]] = [(axis, coordinate) for axis in "xyz"]
    layout += [(f.name, "<" + f.dtype.str[1:], f.shape) for f in fields]
    layout += [("rgba", "<u4") if len(packed) == 4 else ("rgb", "<f4")] if packed else []
    dtype = np.dtype(layout + [(name, "<f8") for name in rests])
    with path.open("wb") as file:
        file.write(header_text(survey, dtype).encode())
        for cloud in stream:
            records = np.empty(len(cloud), dtype)
            for i, axis in enumerate("xyz"):
                records[axis] = cloud.points[:, i]
                if rests:
                    records[rests[i]] = cloud.points[:, i] - records[axis]
            for field in fields:
                records[field.name] = field.values(cloud)
            if packed:
                bits = np.zeros(len(cloud), "<u4")
                for field, shift in zip(packed, (16, 8, 0, 24), strict=False):
                    bits |= field.values(cloud).astype("<u4") << shift
                records["rgba" if len(packed) == 4 else "rgb"] = bits if len(packed) == 4 else bits.view("<f4")
            file.write(records.tobytes())
    return warnings


def header_text(survey: Survey, dtype: np.dtype) -> str:
    names = dtype.names or ()
    types = [dtype[name].base for name in names]
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7"]
    if survey.head.crs:
        lines.append(f"# crs {' '.join(survey.head.crs.splitlines())}")
    lines += [
        "FIELDS " + " ".join(PCL_NAMES.get(name, name) for name in names),
        "SIZE " + " ".join(str(t.itemsize) for t in types),
        "TYPE " + " ".join(t.kind.upper() for t in types),
        "COUNT " + " ".join(str(int(np.prod(dtype[name].shape, dtype=int))) for name in names),
        f"WIDTH {survey.count}",
        "HEIGHT 1",
    ]
    if survey.head.sensor_origin is not None:
        lines.append("VIEWPOINT " + " ".join(repr(float(v)) for v in survey.head.sensor_origin) + " 1 0 0 0")
    return "\n".join([*lines, f"POINTS {survey.count}", "DATA binary\n"])


def pack_colors(fields: list[Field]) -> tuple[list[Field], list[Field]]:
    """The fields red, green, blue and alpha that become one, where all are 8-bit, and the others."""
    by_name = {f.of: f for f in fields}
    channels = [*COLORS, *(["alpha"] if "alpha" in by_name else [])]
    if not all(c in by_name and by_name[c].dtype == np.uint8 and not by_name[c].shape for c in channels):
        return [], fields
    return [by_name[c] for c in channels], [f for f in fields if f.of not in channels]
