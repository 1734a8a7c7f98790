"""Named columns, as PLY, PCD, text and structured NPY hold them, from and to a PointCloud."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import BinaryIO

import numpy as np

from fmr_cli.cloud import NORMALS, PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.stream import COLORS, CloudStream, Column, Survey
from fmr_cli.io.transforms import as_transform

ALIASES = {
    **{f"normal{axis}": f"n{axis}" for axis in "xyz"},
    **{f"n{axis}": f"n{axis}" for axis in "xyz"},
    **{f"{prefix}{color}": color for prefix in ("", "diffuse", "scalar") for color in (*COLORS, "alpha")},
    **{letter: color for letter, color in zip("rgba", (*COLORS, "alpha"), strict=True)},
    **dict.fromkeys(("i", "intensity", "scalarintensity"), "intensity"),
}
# How programs call the coordinates: as `plain` writes a name
AXES = {
    "x": ("x", "xcoord", "xcoordinate", "coordx", "coordinatex", "posx", "positionx", "px", "pointx", "points0",
          "pointsmxyz0", "pointsxyz0", "xyz0", "coordinates0", "position0", "easting", "eastings", "east", "e",
          "ostwert", "rechtswert", "este", "est"),
    "y": ("y", "ycoord", "ycoordinate", "coordy", "coordinatey", "posy", "positiony", "py", "pointy", "points1",
          "pointsmxyz1", "pointsxyz1", "xyz1", "coordinates1", "position1", "northing", "northings", "north", "n",
          "nordwert", "hochwert", "norte", "nord"),
    "z": ("z", "zcoord", "zcoordinate", "coordz", "coordinatez", "posz", "positionz", "pz", "pointz", "points2",
          "pointsmxyz2", "pointsxyz2", "xyz2", "coordinates2", "position2", "elevation", "elev", "height", "altitude",
          "alt", "h", "hoehe", "hohe", "up", "cota", "quota", "hauteur"),
}  # fmt: skip
LONGITUDES, LATITUDES = {"lon", "long", "lng", "longitude"}, {"lat", "latitude"}
# Whole vectors in one field of three
TRIPLES = {
    **dict.fromkeys(("xyz", "points", "point", "position", "positions", "pos", "coords", "coordinates"), "xyz"),
    **dict.fromkeys(("normal", "normals", "n"), NORMALS),
    **dict.fromkeys(("rgb", "color", "colors", "colour", "colours"), COLORS),
}


@lru_cache(maxsize=1 << 12)
def plain(name: str) -> str:
    """A field's name without its unit, quotes and signs, in small letters: "X [m]", "x_coord", "Points:0"."""
    name = "".join(c for c in unicodedata.normalize("NFKD", name.lower()) if not unicodedata.combining(c))
    name = re.sub(r"[\[({].*?[\])}]", "", name).strip().strip("#/\"'% ")
    name = re.sub(r"(?<=[a-z])[ _](m|cm|mm|ft|km|metres?|meters?|feet|deg|degrees?|dd)$", "", name)
    return re.sub(r"[^a-z0-9]", "", name)


def coordinates(names: Iterable[str]) -> list[str] | None:
    """Which of the names are x, y and z, in that order; the plainest spelling first. None where one is missing."""
    spelled: dict[str, str] = {}
    for name in names:
        spelled.setdefault(plain(name), name)
    found = [next((spelled[word] for word in words if word in spelled), None) for words in AXES.values()]
    return None if None in found else [name for name in found if name is not None]


def refuse_degrees(names: Iterable[str]) -> None:
    """Raises CloudFileError where the coordinates are longitude and latitude."""
    words = {plain(name) for name in names}
    if words & LONGITUDES and words & LATITUDES:
        raise CloudFileError(
            "holds longitude and latitude, and degrees are no lengths: project it first, to UTM say "
            "(pyproj, `pdal translate --filters.reprojection.out_srs=...`, QGIS)"
        )


def refuse_poses(rows: np.ndarray) -> None:
    """Raises CloudFileError where numbers (N, k) are those of a 4x4 transform, or each row those of a pose."""
    poses = rows.reshape(1, 16) if rows.shape == (4, 4) else rows if rows.shape[1] in (12, 16) else rows[:0]
    try:
        for pose in poses:
            as_transform(pose.astype(np.float64), mirror=True)
    except CloudFileError:
        return
    if len(poses):
        what = "a 4x4 transform" if rows.shape == (4, 4) else "poses"
        raise CloudFileError(f"holds {what} and no points: give a cloud")


def unique(names: Iterable[str]) -> list[str]:
    """The names, repeated ones told apart by a number: a, b, a -> a, b, a_2."""
    seen: set[str] = set()
    last: dict[str, int] = {}  # number given to a name: a damaged header may repeat one 100,000 times
    result = []
    for name in names:
        free = name
        while free in seen:
            last[name] = last.get(name, 1) + 1
            free = f"{name}_{last[name]}"
        seen.add(free)
        result.append(free)
    return result


def unified(names: list[str]) -> dict[str, str]:
    """Maps each of a file's field names to the name in a PointCloud (see there), x, y and z among them."""
    axes = coordinates(names)
    mapping = dict(zip(axes, "xyz", strict=True)) if axes else {}
    taken = {*names, *mapping.values()}
    for name in names:
        if name in mapping:
            continue
        alias = ALIASES.get(plain(name), name) if len(name) == 1 or len(plain(name)) > 1 else name
        mapping[name] = name if alias in taken else alias
        taken.add(mapping[name])
    return mapping


def to_cloud(columns: Mapping[str, np.ndarray], attributes: bool) -> PointCloud:
    """A cloud of columns of equal length, of which x, y and z must be among them (CloudFileError otherwise)."""
    refuse_degrees(columns)
    columns = parted(columns)
    columns = {new: columns[old] for old, new in unified(list(columns)).items()}
    missing = [axis for axis in "xyz" if axis not in columns or columns[axis].ndim != 1]
    if missing:
        raise CloudFileError(f"has no {', '.join(missing)} among its fields ({', '.join(columns) or 'none'})")
    points = np.empty((len(columns["x"]), 3))
    for i, axis in enumerate("xyz"):
        points[:, i] = columns[axis]
    kept = {name: native(values) for name, values in columns.items() if name not in "xyz"} if attributes else {}
    return PointCloud(points, kept)


def parted(columns: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """Fields of three values that are coordinates, a normal or a colour as three fields; others as they are."""
    result: dict[str, np.ndarray] = {}
    for name, values in columns.items():
        parts = TRIPLES.get(plain(name), ()) if values.ndim == 2 and values.shape[1] == 3 else ()
        if not parts or {*parts} & {*columns}:
            result[name] = values
        else:
            result |= dict(zip(parts, values.T, strict=True))
    return result


def native(values: np.ndarray) -> np.ndarray:
    """A contiguous copy in this machine's byte order."""
    return values.astype(values.dtype.newbyteorder("="))


def bare_names(extra: np.ndarray) -> list[str]:
    """What the columns (N, k) beyond x y z may be where no names are given, told by their values.

    An odd one before threes is the intensity; a three of integers from 0 to 255 is a colour, one of unit vectors a
    normal. Anything else is column_4 and so on.
    """
    count = extra.shape[1]
    generic = [f"column_{4 + k}" for k in range(count)]
    names = ["intensity"] if count % 3 == 1 else []
    while len(names) < count:
        three = extra[:, len(names) : len(names) + 3]
        kind = NORMALS if are_normals(three) else COLORS if are_colors(three) else None
        if three.shape[1] < 3 or kind is None or kind[0] in names:
            return generic
        names += kind
    return names


def are_colors(three: np.ndarray) -> bool:
    return bool(((three >= 0) & (three <= 255) & (three == np.rint(three))).all())


def are_normals(three: np.ndarray) -> bool:
    with np.errstate(all="ignore"):
        length = np.linalg.norm(three.astype(np.float64), axis=1)
    known = length > 0  # where none could be computed, programs write zeros
    return bool(known.any() and (np.abs(length[known] - 1) < 0.01).all())


def bare_cloud(rows: np.ndarray, names: list[str], attributes: bool) -> PointCloud:
    """A cloud of (N, 3 + k) numbers whose further columns are called ``names``."""
    kept = {name: native(rows[:, 3 + i]) for i, name in enumerate(names)} if attributes else {}
    return PointCloud(rows[:, :3].astype(np.float64), kept)


def lost_context(head: PointCloud, suffix: str) -> list[str]:
    """Warnings of a format that has no place for the CRS and the sensor's position."""
    warnings = [f"{suffix} cannot hold the coordinate reference system: left out"] if head.crs else []
    if head.sensor_origin is not None and head.sensor_origin.any():
        warnings.append(f"{suffix} cannot hold the sensor's position: left out")
    return warnings


@dataclass
class Field:
    """A column of a file that is written: the attribute ``of``, or the ``part``-th of its values, as ``dtype``."""

    name: str
    of: str
    dtype: np.dtype
    shape: tuple[int, ...] = ()
    part: int | None = None
    divide: int = 1  # 257: 16-bit colours that are 8-bit ones

    def values(self, cloud: PointCloud) -> np.ndarray:
        values = cloud.attributes[self.of]
        if values.ndim > 1:
            values = values.reshape(len(values), int(np.prod(values.shape[1:])))
            values = values if self.part is None else values[:, self.part]
        return (values // self.divide if self.divide > 1 else values).astype(self.dtype)


def fields_of(survey: Survey, split: bool, eight_bit: bool = False) -> tuple[list[Field], list[str]]:
    """Attributes as columns named without spaces, and a warning for each that had to be renamed or left out.

    split: turns (N, k) ones into k columns; otherwise they stay (N, k). eight_bit: 16-bit colours that are 8-bit ones
    scaled by 257 (as LAS wants them) become 8-bit.
    """
    fields: list[Field] = []
    warnings = []
    colors = [survey.columns[name] for name in (*COLORS, "alpha") if name in survey.columns]
    halve = eight_bit and all(c.dtype == np.uint16 and c.by_257 for c in colors)
    for name, column in survey.columns.items():
        if column.dtype.kind not in "biuf":
            warnings.append(f"attribute {name!r} is not numeric: left out")
            continue
        dtype, divide = column.dtype, 1
        if halve and name in (*COLORS, "alpha"):
            dtype, divide = np.dtype(np.uint8), 257
        width = int(np.prod(column.shape))
        plain_name = safe_name(name)
        parts = [plain_name] if not column.shape or not split else [f"{plain_name}_{k}" for k in range(width)]
        taken = ["x", "y", "z", *(f.name for f in fields)]
        given = [unique([*taken, part])[-1] for part in parts]
        for k, free in enumerate(given):
            whole = not column.shape or not split
            shape = (width,) if column.shape and not split else ()
            fields.append(Field(free, name, dtype, shape, None if whole else k, divide))
        if given != [name]:
            warnings.append(f"attribute {name!r} is written as {', '.join(given)}")
    return fields, warnings


def safe_name(name: str) -> str:
    """The name without what would part it in a header, nor a sign that makes it a formula in a spreadsheet."""
    text = "".join(c if c.isascii() and c.isprintable() and c not in ' ,;#"' else "_" for c in name) or "unnamed"
    return f"_{text[1:]}" if text[0] in "=+-@" else text


def storable(field: Field, column: Column, long_integers: bool) -> str | None:
    """Gives the field a type that PLY and PCD know, and returns a warning where that rounds its values.

    bool as uint8, half as float; 8-byte integers as double where the format has none (PLY).
    """
    kind = field.dtype
    if kind.kind == "b":
        field.dtype = np.dtype(np.uint8)
    elif kind.kind == "f" and kind.itemsize not in (4, 8):
        field.dtype = np.dtype(np.float32 if kind.itemsize < 4 else np.float64)
    elif kind.kind in "iu" and kind.itemsize == 8 and not long_integers:
        field.dtype = np.dtype(np.float64)
        if max(abs(column.low), abs(column.high)) > 2**53:
            return f"{field.name} is rounded to double"
    return None


def write_records(file: BinaryIO, stream: CloudStream, dtype: np.dtype, fields: list[Field]) -> None:
    """Appends the cloud as packed records of ``dtype``: x, y, z and the fields."""
    for cloud in stream:
        records = np.empty(len(cloud), dtype)
        for i, axis in enumerate("xyz"):
            records[axis] = cloud.points[:, i]
        for field in fields:
            records[field.name] = field.values(cloud)
        file.write(records.tobytes())
