"""Named columns, as PLY, PCD, CSV and structured NPY hold them, from and to a PointCloud."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import BinaryIO

import numpy as np

from fmr_cli.cloud import NORMALS, PointCloud
from fmr_cli.errors import CloudFileError

ALIASES = {
    **{axis.upper(): axis for axis in "xyz"},
    **{f"normal_{axis}": f"n{axis}" for axis in "xyz"},
    **{f"{prefix}{color}": color for prefix in ("diffuse_", "scalar_") for color in ("red", "green", "blue", "alpha")},
    **{"r": "red", "g": "green", "b": "blue", "a": "alpha", "R": "red", "G": "green", "B": "blue", "A": "alpha"},
    **{name: "intensity" for name in ("i", "I", "Intensity", "scalar_intensity", "scalar_Intensity")},
    **{name: name.lower() for name in ("Red", "Green", "Blue", "Alpha", "Nx", "Ny", "Nz", "NX", "NY", "NZ")},
}
COLORS = ("red", "green", "blue")
CHUNK = 1 << 20  # rows that are put together at a time, so that a large cloud is never in memory twice


def unique(names: list[str]) -> list[str]:
    """The names, repeated ones told apart by a number: a, b, a -> a, b, a_2."""
    seen: set[str] = set()
    result = []
    for name in names:
        number, free = 1, name
        while free in seen:
            number += 1
            free = f"{name}_{number}"
        seen.add(free)
        result.append(free)
    return result


def unified(names: list[str]) -> dict[str, str]:
    """Maps each of a file's field names to the name in a PointCloud (see there)."""
    taken = set(names)
    mapping = {}
    for name in names:
        alias = ALIASES.get(name, name)
        mapping[name] = name if alias in taken else alias
        taken.add(mapping[name])
    return mapping


def to_cloud(columns: Mapping[str, np.ndarray], attributes: bool) -> PointCloud:
    """A cloud of columns of equal length, of which x, y and z must be among them (CloudFileError otherwise)."""
    columns = {new: columns[old] for old, new in unified(list(columns)).items()}
    missing = [axis for axis in "xyz" if axis not in columns or columns[axis].ndim != 1]
    if missing:
        raise CloudFileError(f"has no {', '.join(missing)} among its fields ({', '.join(columns) or 'none'})")
    points = np.empty((len(columns["x"]), 3))
    for i, axis in enumerate("xyz"):
        points[:, i] = columns[axis]
    kept = {name: native(values) for name, values in columns.items() if name not in "xyz"} if attributes else {}
    return PointCloud(points, kept)


def native(values: np.ndarray) -> np.ndarray:
    """A contiguous copy in this machine's byte order."""
    return np.array(values, dtype=values.dtype.newbyteorder("="))


def flat_columns(attributes: Mapping[str, np.ndarray], split: bool) -> tuple[dict[str, np.ndarray], list[str]]:
    """Attributes as columns named without spaces, and a warning for each that had to be renamed or left out.

    ``split`` turns (N, k) ones into k columns; otherwise they stay (N, k).
    """
    columns: dict[str, np.ndarray] = {}
    warnings = []
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf":
            warnings.append(f"attribute {name!r} is not numeric: left out")
            continue
        flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
        plain = "".join(c if c.isascii() and c.isprintable() and c not in " ,;#" else "_" for c in name) or "unnamed"
        if values.ndim == 1 or not split:
            parts = {plain: values if values.ndim == 1 else flat}
        else:
            parts = {f"{plain}_{k}": flat[:, k] for k in range(flat.shape[1])}
        given = [unique([*"xyz", *columns, part])[-1] for part in parts]
        columns.update(zip(given, parts.values(), strict=True))
        if given != [name]:
            warnings.append(f"attribute {name!r} is written as {', '.join(given)}")
    return columns, warnings


def storable(values: np.ndarray, long_integers: bool) -> np.ndarray:
    """The values in a type that PLY and PCD know: bool as uint8, half as float; 8-byte integers as double for PLY."""
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        return values.astype(np.float32 if values.dtype.itemsize < 4 else np.float64)
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8 and not long_integers:
        return values.astype(np.float64)
    return values


def bare_cloud(rows: np.ndarray, attributes: bool) -> PointCloud:
    """A cloud of (N, 3 + k) numbers without names; what the further columns are is told by their values."""
    if rows.ndim != 2 or rows.shape[1] < 3 or rows.dtype.kind not in "biuf":
        raise CloudFileError(f"holds an array of {rows.shape} {rows.dtype}, points need (N, 3) numbers or more columns")
    extra = rows[:, 3:]
    with np.errstate(all="ignore"):
        last = extra[:, -3:]
        are_colors = bool(((last >= 0) & (last <= 255) & (last == np.rint(last))).all())
        are_normals = bool((np.abs(np.linalg.norm(last, axis=1) - 1) < 0.01).all())
    match extra.shape[1]:
        case 1:
            names: tuple[str, ...] = ("intensity",)
        case 3 if are_colors:
            names = COLORS
        case 3 if are_normals:
            names = NORMALS
        case 4 if are_colors:
            names = ("intensity", *COLORS)
        case k:
            names = tuple(f"column_{4 + i}" for i in range(k))
    kept = {name: native(extra[:, i]) for i, name in enumerate(names)} if attributes else {}
    return PointCloud(rows[:, :3].astype(np.float64), narrow_colors(kept))


def narrow_colors(attributes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Colours that text or plain arrays hold as integers from 0 to 255 (or 65535) in their usual type."""
    present = [name for name in (*COLORS, "alpha") if name in attributes]
    values = [attributes[name] for name in present]
    if not present or not all(((v >= 0) & (v <= 65535) & (v == np.rint(v))).all() for v in values):
        return attributes
    kind = np.uint8 if max(v.max(initial=0) for v in values) <= 255 else np.uint16
    return {**attributes, **{name: attributes[name].astype(kind) for name in present}}


def lost_context(cloud: PointCloud, suffix: str) -> list[str]:
    """Warnings of a format that has no place for the CRS and the sensor's position."""
    warnings = [f"{suffix} cannot hold the coordinate reference system: left out"] if cloud.crs else []
    if cloud.sensor_origin is not None and cloud.sensor_origin.any():
        warnings.append(f"{suffix} cannot hold the sensor's position: left out")
    return warnings


def eight_bit_colors(attributes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """16-bit colours that are 8-bit ones scaled by 257 (as LAS wants them) become 8-bit; everything else stays."""
    result = dict(attributes)
    present = [name for name in (*COLORS, "alpha") if name in result]
    if all(result[name].dtype == np.uint16 and not (result[name] % 257).any() for name in present):
        result.update({name: (result[name] // 257).astype(np.uint8) for name in present})
    return result


def write_records(file: BinaryIO, cloud: PointCloud, dtype: np.dtype, columns: Mapping[str, np.ndarray]) -> None:
    """Appends the cloud as packed records of ``dtype``: x, y, z and the columns."""
    for start in range(0, len(cloud), CHUNK):
        part = slice(start, start + CHUNK)
        records = np.empty(len(cloud.points[part]), dtype)
        for i, axis in enumerate("xyz"):
            records[axis] = cloud.points[part, i]
        for name, values in columns.items():
            records[name] = values[part]
        file.write(records.tobytes())


class Lines:
    """The lines of a text file that are not blank, and the number of the last one handed out."""

    def __init__(self, lines: Iterator[str], number: int = 0) -> None:
        self.lines, self.number, self.last = lines, number, ""

    def __iter__(self) -> Lines:
        return self

    def __next__(self) -> str:
        for line in self.lines:
            self.last, self.number = line, self.number + 1
            if not line.isspace():
                return line
        raise StopIteration


def read_table(
    lines: Lines,
    dtype: np.dtype,
    rows: int | None = None,
    delimiter: str | None = None,
    comments: str | None = None,
) -> np.ndarray:
    """Parses ``rows`` lines of numbers (all, if None) into records of the flat ``dtype``, blank lines left out.

    Raises CloudFileError with the line's number where one does not fit, and where there are too few. The caller has
    checked that the file is long enough for ``rows``, since numpy allocates them first.
    """
    names = dtype.names or ()
    # Everything as float64 first: writers put 255.0 into integer columns. Only 8-byte integers would lose digits.
    wide = np.dtype([(n, dtype[n] if dtype[n].kind in "iu" and dtype[n].itemsize == 8 else np.float64) for n in names])
    if rows == 0:
        return np.empty(0, dtype)
    # numpy prints a warning where there is nothing at all to read
    first = next((line for line in lines if not comments or line.split(comments)[0].strip()), None)
    if first is None:
        if rows:
            raise CloudFileError(f"promises {rows} points and holds none, it is truncated: copy it again")
        return np.empty(0, dtype)
    try:
        table = np.loadtxt(chain([first], lines), wide, comments=comments, delimiter=delimiter, max_rows=rows, ndmin=1)
    except ValueError:
        text = lines.last.strip()[:60]
        raise CloudFileError(f"line {lines.number}: expected {len(names)} numbers, found {text!r}") from None
    if rows is not None and len(table) < rows:
        raise CloudFileError(f"promises {rows} points and ends after {len(table)}, it is truncated: copy it again")
    result = np.empty(len(table), dtype)
    for name in names:
        values = table[name]
        if dtype[name].kind in "iu" and values.dtype.kind == "f":
            limits = np.iinfo(dtype[name])
            if not ((values >= limits.min) & (values <= limits.max) & (values == np.rint(values))).all():
                raise CloudFileError(f"field {name!r} is declared as {dtype[name]} and holds other values")
        result[name] = values
    return result
