"""The table of a batch, results.csv: a row a pair in the manifest's order, gone on with after a kill."""

from __future__ import annotations

import csv
import json
import os
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

from fmr_cli.batch.manifest import Pair
from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import check_writable
from fmr_cli.io.outputs import cell, write_json

COLUMNS = (
    "source", "target", "status", "seconds", "transform", "overlap", "inlier_rmse", "feature_error", "confidence",
    "message",
)  # fmt: skip


class ResultsTable:
    """results.csv in a folder, and settings.json: what all its rows share. A context: it closes the file.

    settings: JSON types.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder, self.settings = folder, settings
        self.path, self.settings_path = folder / "results.csv", folder / "settings.json"
        self.file: TextIO | None = None

    def open(self, pairs: list[Pair], resume: bool) -> list[dict[str, str]]:
        """Make the folder and the table, or with ``resume`` go on with it; returns the rows that are there already.

        A last line that a kill has torn is cut off. Raises CloudFileError where results.csv is there without
        ``resume``, or was made from other pairs or with other settings.
        """
        if not self.folder.is_dir():
            check_writable(self.folder)
        if self.path.exists() and not resume:
            raise CloudFileError(f"{self.path}: is there already, add --resume to go on with it or give another --out")
        self.folder.mkdir(exist_ok=True)
        head = ",".join(COLUMNS).encode() + b"\n"
        whole = self.path.read_bytes() if self.path.exists() else b""
        whole = whole[: whole.rfind(b"\n") + 1]
        rows: list[dict[str, str]] = []
        if whole:
            rows = self._rows_of(whole, head, pairs)
            os.truncate(self.path, len(whole))
        else:
            write_json(self.settings_path, self.settings)
            self.path.write_bytes(head)
        self.file = self.path.open("a", newline="", encoding="utf-8")
        return rows

    def _rows_of(self, whole: bytes, head: bytes, pairs: list[Pair]) -> list[dict[str, str]]:
        if not self.settings_path.exists() or json.loads(self.settings_path.read_text("utf-8")) != self.settings:
            raise CloudFileError(
                f"{self.path}: was made with other settings (see {self.settings_path.name}), give another --out"
            )
        rows = list(csv.DictReader(StringIO(whole.decode("utf-8"), newline="")))
        made_from = [(row.get("source"), row.get("target")) for row in rows]
        if not whole.startswith(head) or made_from != [(cell(p.source), cell(p.target)) for p in pairs[: len(rows)]]:
            raise CloudFileError(f"{self.path}: was made from another manifest, give another --out")
        return rows

    def add(self, row: dict[str, Any]) -> None:
        """A row, on the disk when this returns."""
        assert self.file
        csv.DictWriter(self.file, COLUMNS, lineterminator="\n").writerow({name: cell(row[name]) for name in row})
        self.file.flush()
        os.fsync(self.file.fileno())

    def __enter__(self) -> ResultsTable:
        return self

    def __exit__(self, *_: object) -> None:
        if self.file:
            self.file.close()
