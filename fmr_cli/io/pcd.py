"""PCD 0.7: ascii, binary and binary_compressed. Packed `rgb` becomes red, green, blue; VIEWPOINT the sensor's place."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import (
    COLORS,
    Lines,
    eight_bit_colors,
    flat_columns,
    read_table,
    storable,
    to_cloud,
    unique,
    write_records,
)

LONGEST_HEADER = 1 << 20
PCL_NAMES = {f"n{axis}": f"normal_{axis}" for axis in "xyz"}
RESTS = ("x_rest", "y_rest", "z_rest")
NOTABLE = 1e-5  # a rounding that is worth a warning, as a share of the cloud's extent
LZF_LIMIT = 90  # LZF cannot shrink data more than this many times


@dataclass
class Header:
    fields: np.dtype  # packed, in the file's order; padding fields are called _, __2, ...
    points: int
    viewpoint: tuple[float, ...]  # x y z and a quaternion w x y z; empty where the file has none
    encoding: str
    lines: int
    crs: str | None


def read(path: Path, attributes: bool) -> PointCloud:
    with path.open("rb") as file:
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
        if header.encoding == "ascii":
            records = read_text(file, header)
        elif header.encoding == "binary":
            records = np.fromfile(file, header.fields, header.points)
        else:
            records = read_compressed(file, header)
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
    words: dict[str, list[str]] = {}
    crs = None
    number = 0
    while "DATA" not in words:
        raw = file.readline(LONGEST_HEADER)
        number += 1
        if not raw.endswith(b"\n") or file.tell() > LONGEST_HEADER:
            raise CloudFileError("has no complete PCD header, it is truncated or no PCD file")
        line = raw.decode("utf-8", errors="replace").strip()
        if line.startswith("# crs "):
            crs = line[6:]
        elif line and not line.startswith("#"):
            key, *values = line.split()
            words[key] = values
    try:
        names = words["FIELDS"]
        sizes, kinds = words["SIZE"], words["TYPE"]
        counts = [int(c) for c in words.get("COUNT", ["1"] * len(names))]
        if not len(names) == len(sizes) == len(kinds) == len(counts) or min(counts) < 1 or max(counts) > 1 << 20:
            raise ValueError
        if any(
            kind + size not in ("F4", "F8", *(k + s for k in "IU" for s in "1248"))
            for kind, size in zip(kinds, sizes, strict=True)
        ):
            raise ValueError
        types = [f"<{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True)]
        layout = [(n, t) if c == 1 else (n, t, (c,)) for n, t, c in zip(unique(names), types, counts, strict=True)]
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


def read_text(file: BinaryIO, header: Header) -> np.ndarray:
    lines = Lines((line.decode("utf-8", errors="replace") for line in file), header.lines)
    flat = read_table(lines, np.dtype(flat_names(header.fields)), header.points)
    return np.frombuffer(flat.tobytes(), header.fields, len(flat))


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


def write(path: Path, cloud: PointCloud) -> list[str]:
    """DATA binary; 8-bit colours packed, everything else in its own type.

    PCL and Open3D know float32 coordinates only (Open3D takes F 8 for zeros), so x y z are F 4; where that rounds them,
    what is missing stands in the fields x_rest y_rest z_rest, and `read` adds it again.
    """
    columns, warnings = flat_columns(pack_colors(eight_bit_colors(cloud.attributes)), split=False)
    columns = {name: storable(values, long_integers=True) for name, values in columns.items()}
    with np.errstate(over="ignore", invalid="ignore"):
        rest = cloud.points - cloud.points.astype(np.float32)
    coordinate = "<f4" if np.isfinite(rest).all() else "<f8"
    if coordinate == "<f4" and rest.any():
        columns |= {name: rest[:, i] for i, name in enumerate(RESTS)}
        if np.abs(rest).max() > NOTABLE * np.ptp(cloud.points, axis=0).max():
            error = np.abs(rest).max()
            warnings.append(f"most readers of PCD take float32 only and will round coordinates by up to {error:.2g}")
    counts = {name: values[0].size for name, values in columns.items()}
    dtype = np.dtype(
        [(axis, coordinate) for axis in "xyz"] + [(n, "<" + v.dtype.str[1:], v.shape[1:]) for n, v in columns.items()]
    )
    names = dtype.names or ()
    types = [dtype[name].base for name in names]
    header = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7"]
    if cloud.crs:
        header.append(f"# crs {' '.join(cloud.crs.splitlines())}")
    header += [
        "FIELDS " + " ".join(PCL_NAMES.get(name, name) for name in names),
        "SIZE " + " ".join(str(t.itemsize) for t in types),
        "TYPE " + " ".join(t.kind.upper() for t in types),
        "COUNT " + " ".join(str(counts.get(name, 1)) for name in names),
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
    ]
    if cloud.sensor_origin is not None:
        header.append("VIEWPOINT " + " ".join(repr(float(v)) for v in cloud.sensor_origin) + " 1 0 0 0")
    header += [f"POINTS {len(cloud)}", "DATA binary\n"]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        write_records(file, cloud, dtype, columns)
    return warnings


def pack_colors(attributes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The reverse of unpack_colors, where all channels are 8-bit; other colours stay fields of their own."""
    channels = [*COLORS, *(["alpha"] if "alpha" in attributes else [])]
    if not all(c in attributes and attributes[c].dtype == np.uint8 and attributes[c].ndim == 1 for c in channels):
        return attributes
    red, green, blue, *alpha = (attributes[c].astype("<u4") for c in channels)
    bits = red << 16 | green << 8 | blue
    packed = {"rgba": bits | alpha[0] << 24} if alpha else {"rgb": bits.view("<f4")}
    return {**{name: v for name, v in attributes.items() if name not in channels}, **packed}
