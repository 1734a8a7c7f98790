"""XYZ, TXT, CSV, ASC and PTS: one point a line, as many programs write it; see `find_dialect` for how it is told."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import (
    bare_cloud,
    bare_names,
    coordinates,
    fields_of,
    lost_context,
    refuse_degrees,
    refuse_poses,
    to_cloud,
    unique,
)
from fmr_cli.io.stream import COLORS, CloudStream, Wanted
from fmr_cli.io.table import COMMENT, MOST_COLUMNS, ROWS, THOUSANDS, Dialect, Lines, Rows, number_in, open_text, parse

HEAD = 200  # lines that are looked at to tell how the file is written
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eEdD][+-]?\d+)?")
PTS = ("intensity", *COLORS)  # what a PTS line may hold after x y z, in that order
PREAMBLE = 30  # lines before the names, at most
FLAT = 100  # times as high as wide: a pole, or longitude and latitude with a height in metres
DEGREES = "its x and y may be longitude and latitude, and degrees are no lengths: if so, project it first, to UTM say"
BRACKETED = re.compile(r"\s*[\[({]\s*([\[({\"]|[+-]?[.\d])")  # JSON, Python, WKT: a list of points and no table
SEXAGESIMAL = re.compile(r"[+-]?\d{1,3}[:\u00b0]\d{1,2}([:'\u2032].*)?")  # degrees, minutes and seconds
MARKS = re.compile(r"\s*(rem\b|[#%/;!'*-]+)", re.IGNORECASE)  # that begin a comment
SEQUENCE = 20  # rows numbered 1, 2, 3 ... that make a first column the points' numbers


@dataclass
class Table:
    """How a file is written. names: of the columns that are used, or none. promised: the count in its first line."""

    dialect: Dialect
    names: list[str]
    left_out: tuple[str, ...]
    promised: int | None


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    """Numbers are float64. Columns without names are told by their values (`fields.bare_names`)."""
    with open_text(path) as file:
        lines = Lines(file)
        head = lines.take(HEAD)
        table = find_table(head)
        names = table.names or [f"column_{k + 1}" for k in range(len(table.dialect.used))]
        dtype = np.dtype([(name, np.float64) for name in names])
        bare: list[str] | None = None
        done, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
        lines.skip = COMMENT  # in the head they may name the columns
        rest = iter(lambda: lines.take(ROWS), None)
        for rows in chain([head], rest):
            last = not rows.lines
            if table.promised is not None:
                table.promised += sum(counts_between(rows))
            values = parse(rows, dtype, table.dialect)
            done += len(values)
            if table.names:
                cloud = to_cloud({name: values[name] for name in names}, wanted.attributes)
            else:
                matrix = values.view(np.float64).reshape(len(values), len(names))
                if done == len(values):
                    refuse_poses(matrix)
                bare = bare_names(matrix[:, 3:]) if bare is None else bare
                cloud = bare_cloud(matrix, bare, wanted.attributes)
            cloud.left_out = table.left_out
            if len(cloud):
                low, high = np.fmin(low, np.fmin.reduce(cloud.points)), np.fmax(high, np.fmax.reduce(cloud.points))
            if last:
                cloud.notes = (DEGREES,) if like_degrees(low, high) else ()
            if not last or done == 0 or cloud.notes:
                yield cloud
            if last:
                break
    if table.promised is not None and done != table.promised:
        what = "it is truncated: copy it again" if done < table.promised else "its first line is no count: take it out"
        raise CloudFileError(f"promises {table.promised} points in its first line and holds {done}, {what}")


def like_degrees(low: np.ndarray, high: np.ndarray) -> bool:
    """Whether x and y may be longitude and latitude, by the bounds (3,): within a globe's, and flat beside heights.

    A degree is 111 km: what a scan spans of degrees is a hundredth at most of what it spans in height, in metres.
    """
    x, y, z = high - low
    largest = np.sort(np.abs([low, high]).max(0)[:2])
    return bool(largest[0] <= 90 and largest[1] <= 180 and 0 < max(x, y) < z / FLAT)


def counts_between(rows: Rows) -> Iterator[int]:
    """Takes the lines out that hold a count alone, as PTS has them between its scans, and hands the counts out."""
    for i in reversed([i for i, line in enumerate(rows.lines) if len(line) < 20 and line.strip().isdecimal()]):
        yield int(rows.lines.pop(i))
        rows.numbers.pop(i)


def find_table(head: Rows) -> Table:
    """How the file is written, told by its first lines; leaves those in ``head`` that hold points.

    Names may stand in the first line, or in a comment before the points. Raises CloudFileError where the names tell of
    other things than x y z, or of degrees, and where a line has fewer than three columns.
    """
    comments: list[str] = []
    while head.lines and COMMENT.match(head.lines[0]):
        comments.append(MARKS.sub("", head.lines.pop(0)).strip())
        head.numbers.pop(0)
    for i in reversed([i for i, line in enumerate(head.lines) if COMMENT.match(line)]):
        del head.lines[i], head.numbers[i]
    if head.lines and BRACKETED.match(head.lines[0]):
        raise CloudFileError(
            f"line {head.numbers[0]}: has brackets around its points, as JSON has: write a point a line, x y z alone"
        )
    promised = None
    if len(head.lines) > 1 and head.lines[0].strip().isdecimal():
        promised = int(head.lines.pop(0))
        head.numbers.pop(0)
    named: list[str] = []
    skip_preamble(head)
    if head.lines and sum(1 for word in head.lines[0].replace(",", " ").split() if SEXAGESIMAL.fullmatch(word)) > 1:
        refuse_degrees(("lon", "lat"))
    if head.lines and not any(map(is_number, first := names_in(head.lines[0]))):
        refuse_degrees(first)
        if not coordinates(first):
            raise CloudFileError(
                f"line {head.numbers[0]}: expected numbers between blanks, tabs or one of , ; : |, or names of which "
                f"some are x, y and z (Easting, Northing, Elevation and the like), found {head.lines[0].strip()[:60]!r}"
            )
        named = first
        del head.lines[0], head.numbers[0]
    if not head.lines:
        raise CloudFileError("holds no points")
    dialect = find_dialect(head)
    if dialect.trailing and len(named) == dialect.columns + 1 and named[-1]:  # a last column that is empty so far
        dialect.trailing, dialect.columns = False, len(named)
        dialect.used = list(range(dialect.columns))
    for comment in comments if not named else []:
        words = names_in(comment)
        refuse_degrees(words)
        if coordinates(words) and len(words) <= dialect.columns:
            named = words
    if dialect.columns < 3:
        raise CloudFileError(f"line {head.numbers[0]}: has {dialect.columns} columns, a point has at least x y z")
    if named and len(named) < dialect.columns:
        named = [*named, *(f"column_{k + 1}" for k in range(len(named), dialect.columns))]
    elif len(named) > dialect.columns:
        surplus = named[dialect.columns :]
        if any(surplus):
            raise CloudFileError(
                f"line {head.numbers[0]}: expected {len(named)} numbers, found {head.lines[0].strip()[:60]!r}"
            )
        named = named[: dialect.columns]
    return use_numbers(head, dialect, unique(name or "unnamed" for name in named), promised)


def skip_preamble(head: Rows) -> None:
    """Takes out lines of words before the one that names the columns, as reports have them."""
    if head.lines and head.lines[0].split()[0].lower() == "ncols":
        raise CloudFileError("is an ESRI grid, a raster of heights and no points: gdal2xyz or QGIS make points of it")
    for i, line in enumerate(head.lines[:PREAMBLE]):
        words = names_in(line)
        if len(words) > MOST_COLUMNS:
            raise CloudFileError(f"line {head.numbers[i]}: has {len(words)} columns, it is no table of points")
        if sum(map(is_number, words)) >= 3:
            return
        if coordinates(words):
            del head.lines[:i], head.numbers[:i]
            return


def use_numbers(head: Rows, dialect: Dialect, named: list[str], promised: int | None) -> Table:
    """Leaves columns of text out, and the points' own numbers where nothing says what the columns are."""
    cells = [row for row in map(dialect.cells, head.lines) if len(row) == dialect.columns]
    axes = [named.index(name) for name in coordinates(named) or ()]
    words = [
        k for k in range(dialect.columns) if k not in axes and any(is_text(row[k]) for row in cells)
    ]  # fmt: skip
    if not named and dialect.columns - len(words) < 3:
        words = []  # the line that does not fit will be named
    left_out = [f"text column {named[k]!r}" if named else f"text column {k + 1}" for k in words]
    used = [k for k in range(dialect.columns) if k not in words]
    if not named and len(used) > 3 and len(cells) >= SEQUENCE:
        first = [row[used[0]].strip() for row in cells]
        if all(text.isdecimal() for text in first) and (np.diff(np.array(first, float)) == 1).all():
            left_out.append(f"column {used[0] + 1}, the points' numbers")
            used = used[1:]
    dialect.used = used
    return Table(dialect, [named[k] for k in used] if named else [], tuple(left_out), promised)


def find_dialect(head: Rows) -> Dialect:
    """What separates the cells, told by the first lines, whether commas are decimal, and how many columns there are."""
    lines = head.lines
    delimiter = next((d for d in ";|" if d in lines[0]), ":" if colons_part(lines[0]) else None)
    if delimiter is None and len({line.rstrip("\n").count("\t") for line in lines}) == 1 and "\t" in lines[0]:
        delimiter = "\t" if not any(map(blanks_part, lines[0].split("\t"))) else None
    quoted = any('"' in line for line in lines)
    comma = delimiter is not None and any(DECIMAL_COMMA.fullmatch(c.strip(' "')) for c in lines[0].split(delimiter))
    if delimiter is None and "," in lines[0]:
        cells = next(csv.reader([lines[0]], skipinitialspace=True))
        if any(re.search(r"\d\s+[+-]?\d", cell) for cell in cells):
            comma = all(DECIMAL_COMMA.fullmatch(c) or is_number(c) for c in lines[0].split())
        if not comma:
            delimiter = ","
            if quoted and any("," in c for c in cells):  # "1,5","2,5": decimals; "1,234.5": marks between thousands
                comma = not any(THOUSANDS.fullmatch(c.strip()) for c in cells)
    cells = [cell.strip(' "\n') for line in lines for cell in line.split(delimiter)] if comma else []
    marked = next((c for c in cells if THOUSANDS.fullmatch(c) and re.search(r"[. ]", c)), None)
    if marked is not None and delimiter != ",":
        raise CloudFileError(
            f"{marked!r} has marks between the thousands as well as decimals: export it again without them"
        )
    if delimiter == "," and (comma or decimals_between_commas(lines)):
        raise CloudFileError("has commas both as decimals and between the columns: export it with semicolons or points")
    trailing = delimiter is not None and all(line.rstrip(" \r\n").endswith(delimiter) for line in lines)
    dialect = Dialect(0, [], delimiter, comma, quoted, trailing)
    widths = [len(dialect.cells(line)) for line in lines]
    dialect.columns = max(set(widths), key=lambda width: (widths.count(width), width))
    if trailing and dialect.columns < 3:  # 1,2,3 where the last cells are empty: no trailing delimiter after all
        dialect.trailing = False
        dialect.columns = len(dialect.cells(lines[0]))
    dialect.used = list(range(dialect.columns))
    return dialect


def colons_part(line: str) -> bool:
    """Whether what stands between colons are numbers, or the names of coordinates."""
    cells = line.split(":")
    return len(cells) > 2 and (all(map(is_number, cells)) or coordinates(cells) is not None)


def blanks_part(cell: str) -> bool:
    """Whether a cell between tabs holds several numbers between blanks."""
    return len(cell.split()) > 1 and all(map(is_number, cell.split())) and not THOUSANDS.fullmatch(cell.strip())


def decimals_between_commas(lines: list[str]) -> bool:
    """Whether lines such as 101,870,-3,050 have decimal commas: every other cell is digits, some with a 0 first."""
    cells = [[cell.strip() for cell in line.rstrip("\n").split(",")] for line in lines]
    if any(len(row) < 6 or len(row) % 2 for row in cells):
        return False
    wholes, shares = [c for row in cells for c in row[::2]], [c for row in cells for c in row[1::2]]
    return (
        all(re.fullmatch(r"[+-]?\d+", c) for c in wholes) and all(c.isdecimal() for c in shares)
        and any(len(c) > 1 and c[0] == "0" for c in shares)
    )  # fmt: skip


def names_in(line: str) -> list[str]:
    """The words of a line that may name columns; their units stay, but where blanks separate."""
    delimiter = next((d for d in ";\t|," if d in line), ":" if colons_part(line) else None)
    if delimiter is None:
        line = re.sub(r"\s*[\[(][^\])]*[\])]", "", line)
        return line.strip().lstrip("#%/;!").split()
    words = next(csv.reader([line.strip("\n")], delimiter=delimiter, skipinitialspace=True))
    return [word.strip().lstrip("#%/").strip().strip("'") for word in words]


def is_number(cell: str) -> bool:
    """Whether a cell holds a number, whatever its decimals are parted by; a word for a missing one is none."""
    try:
        return not np.isnan(number_in(cell.replace(",", ".")))
    except ValueError:
        return False


def is_text(cell: str) -> bool:
    """Whether a cell holds neither a number, nor a word for a missing one, nor a number with marks in it."""
    try:
        number_in(cell.replace(",", "."))
    except ValueError:
        return not THOUSANDS.fullmatch(cell.strip().strip('"'))
    return False


def write(path: Path, stream: CloudStream) -> list[str]:
    """CSV with a row of names; others with one behind # if there is more than x y z. Shortest exact numbers."""
    suffix = path.suffix.lower()
    fields, warnings = fields_of(stream.survey, split=True, eight_bit=suffix == ".pts")
    delimiter = "," if suffix == ".csv" else " "
    if suffix == ".pts":
        fitting = [f for f in fields if f.of in PTS and (f.of == "intensity" or f.dtype == np.uint8)]
        lost = [f.name for f in fields if f not in fitting]
        fields = sorted(fitting, key=lambda f: PTS.index(f.of))
        warnings += [f".pts cannot hold the attributes {', '.join(lost)}: left out"] if lost else []
    names = delimiter.join(["x", "y", "z", *(f.name for f in fields)])
    with path.open("w", encoding="utf-8", newline="") as file:
        if suffix == ".pts":
            file.write(f"{stream.survey.count}\n")
        elif delimiter == ",":
            file.write(f"{names}\n")
        elif fields:
            file.write(f"# {names}\n")
        rows = csv.writer(file, delimiter=delimiter, lineterminator="\n")
        for cloud in stream:
            values = [*cloud.points.T.tolist(), *(f.values(cloud).tolist() for f in fields)]
            rows.writerows(zip(*values, strict=True))
    return warnings + lost_context(stream.survey.head, path.suffix)
