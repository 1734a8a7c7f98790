"""XYZ, TXT and CSV: one point a line, with or without a row of names."""

from __future__ import annotations

import csv
from itertools import chain
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import (
    CHUNK,
    Lines,
    bare_cloud,
    flat_columns,
    lost_context,
    narrow_colors,
    read_table,
    to_cloud,
    unified,
    unique,
)


def read(path: Path, attributes: bool) -> PointCloud:
    """Columns separated by commas, semicolons or blanks. The names may stand behind # or //, as CloudCompare puts them.

    Without names they are x y z, then one column of intensity, three of 8-bit colours or unit normals, or intensity
    and colours; anything else is called column_4 and so on. Numbers are float64, colours integers.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = Lines(file)
        names, delimiter, first = find_header(lines)
        count = len(names) if names else len(first.split(delimiter))
        if count < 3:
            raise CloudFileError(f"line {lines.number}: has {count} columns, a point has at least x y z")
        if first:
            lines = Lines(chain([first], file), lines.number - 1)
        dtype = np.dtype([(name, np.float64) for name in names or [f"column_{k + 1}" for k in range(count)]])
        table = read_table(lines, dtype, delimiter=delimiter, comments="#")
    if names:
        cloud = to_cloud({name: table[name] for name in names}, attributes)
        cloud.attributes = narrow_colors(cloud.attributes)
        return cloud
    return bare_cloud(table.view(np.float64).reshape(len(table), count), attributes)


def find_header(lines: Lines) -> tuple[list[str], str | None, str]:
    """The names (or none), the delimiter, and the first line of numbers if it has been consumed."""
    for line in lines:
        text = line.strip().lstrip("#/").strip()
        delimiter = next((d for d in ",;" if d in text), None)
        words = [word.strip().strip('"') for word in text.split(delimiter)]
        if {"x", "y", "z"} <= set(unified(words).values()):
            return unique([word or "unnamed" for word in words]), delimiter, ""
        if not text or line.lstrip().startswith(("#", "//")):
            continue
        return [], delimiter, line
    raise CloudFileError("holds no points")


def write(path: Path, cloud: PointCloud) -> list[str]:
    """CSV with a row of names; XYZ and TXT with one behind # if there is more than x y z. Shortest exact numbers."""
    columns, warnings = flat_columns(cloud.attributes, split=True)
    delimiter = "," if path.suffix.lower() == ".csv" else " "
    names = delimiter.join(["x", "y", "z", *columns])
    with path.open("w", encoding="utf-8", newline="") as file:
        if delimiter == ",":
            file.write(f"{names}\n")
        elif columns:
            file.write(f"# {names}\n")
        rows = csv.writer(file, delimiter=delimiter, lineterminator="\n")
        for start in range(0, len(cloud), CHUNK // 8):
            part = slice(start, start + CHUNK // 8)
            values = [*cloud.points[part].T.tolist(), *(column[part].tolist() for column in columns.values())]
            rows.writerows(zip(*values, strict=True))
    return warnings + lost_context(cloud, path.suffix)
