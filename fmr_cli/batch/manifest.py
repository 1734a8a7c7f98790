"""The manifest of a batch: a CSV file with a pair a line."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import check_readable, reason


@dataclass(frozen=True)
class Pair:
    """One line of a manifest. source, target, init: as written there; name: unique, safe as a file name."""

    source: str
    target: str
    init: str
    name: str


def read_manifest(path: Path) -> list[Pair]:
    """The pairs of a CSV file with the columns source and target, and optionally init and name.

    A pair without a name is called after its line and its files. Raises CloudFileError.
    """
    check_readable(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file, skipinitialspace=True) if any(cell.strip() for cell in row)]
    except (csv.Error, UnicodeDecodeError) as error:
        raise CloudFileError(f"{path}: is no CSV file ({reason(error)}), check how it was written") from None
    columns = [cell.strip() for cell in rows[0]] if rows else []
    if not {"source", "target"} <= set(columns):
        found = ", ".join(columns)[:100] or "nothing"
        raise CloudFileError(f"{path}: its first line must name the columns source and target, found {found}")
    if len(rows) == 1:
        raise CloudFileError(f"{path}: lists no pair, add a line for each")
    pairs: list[Pair] = []
    taken: set[str] = set()
    for number, row in enumerate(rows[1:], 1):
        cells = dict(zip(columns, (cell.strip() for cell in row), strict=False))
        source, target = cells.get("source", ""), cells.get("target", "")
        if not source or not target:
            raise CloudFileError(f"{path}: pair {number} has no {'target' if source else 'source'}, fill it in")
        name = safe(cells.get("name") or f"{number:0{len(str(len(rows)))}}_{Path(source).stem}_{Path(target).stem}")
        name = next(free for free in numbered(name) if free.casefold() not in taken)
        taken.add(name.casefold())
        pairs.append(Pair(source, target, cells.get("init", ""), name))
    return pairs


def safe(name: str) -> str:
    """The name with nothing in it that a file system could take for something else, at most 100 characters."""
    return re.sub(r"[^\w.+-]", "_", name)[:100].lstrip(".") or "pair"


def numbered(name: str) -> Iterator[str]:
    """name, name_2, name_3, ..."""
    yield name
    number = 1
    while True:
        number += 1
        yield f"{name}_{number}"
