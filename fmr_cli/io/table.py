"""Lines of numbers, as text holds them: bounded lines in, arrays out, the number of a line that does not fit."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TextIO

import numpy as np

from fmr_cli.errors import CloudFileError
from fmr_cli.io.stream import CHUNK

MOST_COLUMNS = 10_000  # of a point; each costs time, whether or not it holds anything
LONGEST_LINE = 1 << 20  # characters: a point has some hundred at most
BLOCK = 1 << 22  # characters read at a time
ROWS = CHUNK // 4  # lines parsed at a time: each is a Python object until it is parsed
# How a line begins that is for people. BASIC's REM and ' stand for themselves, 'x','y' is two cells between quotes; --
# and * alone stand for a missing number.
COMMENT = re.compile(r"""\s*([#%;!]|//|/\*|rem\b|(--|\*)\s*[a-z]|'(?![^']*'\s*([,;|\t ]|$)))""", re.IGNORECASE)
AMONG_POINTS = re.compile(
    r"\s*([#%;!]|//|comment\b|obj_info\b)", re.IGNORECASE
)  # a comment among a PLY's or PCD's points
# What programs write where there is no number
MISSING = {"", "nan", "+nan", "-nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?", "nan(ind)", "-nan(ind)",
           "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "#num!", "*"}  # fmt: skip
END_OF_FILE = "\x1a"  # of DOS
MINUS = "\u2212"  # of typesetters
INFINITE = {"1.#inf": np.inf, "-1.#inf": -np.inf}
FORTRAN = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)[dD][+-]?\d+")
# 1 234.5, 1'234.5; 1,234,567; 1,234.5; 1.234,5; 1.234.567
THOUSANDS = re.compile(
    r"[+-]?\d{1,3}([ '\u00a0\u2019\u202f]\d{3})+([.,]\d*)?|[+-]?\d{1,3}(,\d{3}){2,}"
    r"|[+-]?\d{1,3}(,\d{3})+\.\d+|[+-]?\d{1,3}(\.\d{3})+,\d+|[+-]?\d{1,3}(\.\d{3}){2,}"
)
# Coordinates shrink to a fifth, those of a grid to a twentieth; what shrinks more is no scan.
GZIP_RATIO, GZIP_LEAST = 25, 10_000_000


@contextmanager
def open_text(path: Path) -> Iterator[TextIO]:
    """A text file as str, with Unix line ends: UTF-8 or UTF-16, with or without a mark, gzip by its first bytes."""
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        binary: Any = BoundedGzip(raw, path.stat().st_size) if packed else raw
        head = binary.read(4096)
        binary.seek(0)
        if packed:
            while binary.read1(BLOCK):  # whether it is too large, before anything is made of it
                pass
            binary.seek(0)
        with io.TextIOWrapper(binary, encoding=encoding_of(head), errors="replace") as file:
            yield file


class BoundedGzip(gzip.GzipFile):
    """A gzip file that gives no more than GZIP_RATIO times what it takes."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        super().__init__(fileobj=file)
        self.most = max(GZIP_LEAST, GZIP_RATIO * size)

    def read1(self, size: int = -1) -> bytes:
        data = super().read1(size)
        if self.tell() > self.most:
            raise CloudFileError(f"unpacks to more than {GZIP_RATIO} times its size, no scan does: unpack it yourself")
        return data


def encoding_of(head: bytes) -> str:
    if head.startswith((b"\xff\xfe\0\0", b"\0\0\xfe\xff")):
        return "utf-32"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if len(head) > 8 and head[1::2].count(0) > 0.9 * (len(head) // 2):
        return "utf-16-le"
    if len(head) > 8 and head[::2].count(0) > 0.9 * (len(head) // 2):
        return "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)  # its last letter may be cut
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


class Lines:
    """The lines of a text file that are not blank, and the number of the last one handed out."""

    def __init__(self, file: TextIO, number: int = 0, skip: re.Pattern[str] | None = None) -> None:
        """number: of lines before. skip: matches the beginning of lines that are passed over."""
        self.number, self.last, self.skip = number, "", skip
        self.lines = self.read(file)

    @staticmethod
    def read(file: TextIO) -> Iterator[str]:
        rest = ""
        while text := file.read(BLOCK):
            *whole, rest = (rest + text).split("\n")
            yield from whole
            if len(rest) > LONGEST_LINE:
                raise CloudFileError(f"has a line of more than {LONGEST_LINE} characters, it is no table of points")
        if rest:
            yield rest

    def __iter__(self) -> Lines:
        return self

    def __next__(self) -> str:
        for line in self.lines:
            self.number += 1
            if line and not line.isspace() and line != END_OF_FILE and not (self.skip and self.skip.match(line)):
                self.last = line
                return line
        raise StopIteration

    def take(self, count: int) -> Rows:
        """At most ``count`` lines."""
        rows = Rows()
        for line in self:
            rows.lines.append(line)
            rows.numbers.append(self.number)
            if len(rows.lines) >= count:
                break
        return rows


@dataclass
class Rows:
    """Lines of a table that hold points."""

    lines: list[str] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)  # of the lines in the file, from 1


@dataclass
class Dialect:
    """How one line is cut into cells, and which of them are numbers to be read.

    delimiter: None for any blanks. used: places of the cells that are read, of ``columns`` in all.
    """

    columns: int
    used: list[int]
    delimiter: str | None = None
    decimal_comma: bool = False
    quoted: bool = False
    trailing: bool = False  # each line ends in a delimiter that nothing follows

    def tidy(self, line: str) -> str:
        """The line as numpy's reader takes it."""
        if self.trailing:
            line = line.rstrip(" \r\n").removesuffix(self.delimiter or "")
        return line.replace(",", ".") if self.decimal_comma else line

    def cells(self, line: str) -> list[str]:
        line = self.tidy(line)
        if self.quoted:
            return next(csv.reader([line], delimiter=self.delimiter or " ", skipinitialspace=True))
        return line.split(self.delimiter)


def parse(rows: Rows, dtype: np.dtype, dialect: Dialect) -> np.ndarray:
    """Lines as records of the flat ``dtype``, one field for each cell that is used.

    Raises CloudFileError with the line's number where one does not fit.
    """
    names = dtype.names or ()
    # Everything as float64 first: writers put 255.0 into integer columns. Only 8-byte integers would lose digits.
    wide = np.dtype([(n, dtype[n] if dtype[n].kind in "iu" and dtype[n].itemsize == 8 else np.float64) for n in names])
    if not rows.lines:
        return np.empty(0, dtype)
    lines = rows.lines
    if dialect.trailing or dialect.decimal_comma:
        lines = [dialect.tidy(line) for line in lines]
    used = None if dialect.used == list(range(dialect.columns)) else dialect.used
    try:
        table = np.loadtxt(lines, wide, comments=None, delimiter=dialect.delimiter, usecols=used, ndmin=1,
                           quotechar='"' if dialect.quoted else None)  # fmt: skip
        if len(table) != len(lines):
            raise ValueError
    except ValueError:
        table = parse_slowly(rows, wide, dialect)
    result = np.empty(len(table), dtype)
    for name in names:
        values = table[name]
        if dtype[name].kind in "iu" and values.dtype.kind == "f":
            limits = np.iinfo(dtype[name])
            if not ((values >= limits.min) & (values <= limits.max) & (values == np.rint(values))).all():
                raise CloudFileError(f"field {name!r} is declared as {dtype[name]} and holds other values")
        result[name] = values
    return result


def parse_slowly(rows: Rows, dtype: np.dtype, dialect: Dialect) -> np.ndarray:
    """As `parse`, for what numpy's reader does not take: cells without a number, Fortran's exponents, commas."""
    result = []
    kinds = [dtype[name].kind for name in dtype.names or ()]
    for line, number in zip(rows.lines, rows.numbers, strict=True):
        cells = dialect.cells(line)
        if dialect.delimiter is None and not dialect.decimal_comma and ("," in line or ";" in line):
            cells = line.replace(",", " ").replace(";", " ").split()  # PLY and PCD with commas or semicolons
        if 3 <= len(cells) == dialect.columns - 1 and dialect.delimiter is not None and dialect.used[-1] == len(cells):
            cells.append("")  # a last cell that is empty and whose delimiter an editor has cut off
        try:
            if len(cells) != dialect.columns:
                raise ValueError
            used = (cells[i] for i in dialect.used)
            result.append(tuple(number_in(c) if kind == "f" else int(c) for c, kind in zip(used, kinds, strict=True)))
        except ValueError as error:
            if isinstance(error, CloudFileError):
                raise
            if "\0" in line:
                what = "holds zero bytes, it was not written to its end: copy it again"
                raise CloudFileError(f"line {number}: {what}") from None
            text = line.strip()[:60]
            bad = next((c.strip() for c in (cells[i] for i in dialect.used if i < len(cells))
                        if THOUSANDS.fullmatch(c.strip().strip('"'))), None)  # fmt: skip
            if bad is not None:
                raise CloudFileError(
                    f"line {number}: {bad!r} has marks between the thousands, which may also be decimals: "
                    "export it again without them"
                ) from None
            raise CloudFileError(f"line {number}: expected {dialect.columns} numbers, found {text!r}") from None
    return np.array(result, dtype)


def number_in(cell: str) -> float:
    """The number in a cell, NaN for a word that says that there is none. Raises ValueError for any other text."""
    text = cell.strip().strip("\"'").strip().replace(MINUS, "-")
    try:
        if "_" not in text:  # Python's own mark between digits
            return float(text)
    except ValueError:
        pass
    low = text.lower()
    if low in MISSING:
        return np.nan
    if low in INFINITE:
        return INFINITE[low]
    if FORTRAN.fullmatch(text):
        return float(low.replace("d", "e"))
    raise ValueError(text)


def beyond(lines: Lines, promised: int, others: int = 0) -> tuple[str, ...]:
    """A note, where lines are left beyond the points that a header promises and ``others`` of other elements."""
    left = sum(1 for _ in lines) - others
    if left <= 0:
        return ()
    what = "1 line lies" if left == 1 else f"{left} lines lie"
    return (f"{what} beyond the {promised} points that its header promises, not read: mend the header if it is wrong",)


def read_rows(lines: Lines, dtype: np.dtype, count: int) -> Iterator[np.ndarray]:
    """``count`` lines of numbers between blanks (or commas) as records, some at a time.

    Raises CloudFileError where one does not fit, and where there are too few.
    """
    columns = len(dtype.names or ())
    dialect = Dialect(columns, list(range(columns)))
    done = 0
    while done < count:
        rows = lines.take(min(ROWS, count - done))
        if not rows.lines:
            what = f"ends after {done}" if done else "holds none"
            raise CloudFileError(f"promises {count} points and {what}, it is truncated: copy it again")
        yield parse(rows, dtype, dialect)
        done += len(rows.lines)
