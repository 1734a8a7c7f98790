"""What a registration leaves behind besides its transform: moved and merged clouds, metrics as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import atomic_write, check_writable

FORMULA = ("=", "+", "-", "@", "\t", "\r")  # how a cell begins that spreadsheets compute


def check_outputs(outputs: Iterable[tuple[Path | None, Iterable[str]]]) -> None:
    """Each (path or None, suffixes it may have): its folder is there, its suffix known, and no path given twice.

    Raises CloudFileError, so that a long computation does not end in an output that cannot be written.
    """
    seen = set()
    for path, suffixes in outputs:
        if path is None or (path.exists() and not path.is_file() and not path.is_dir()):  # a device or a pipe
            continue
        if path.suffix.lower() not in suffixes:
            raise CloudFileError(f"{path}: cannot write the suffix {path.suffix!r}, use one of {' '.join(suffixes)}")
        if path.resolve() in seen:
            raise CloudFileError(f"{path}: is given for two outputs, choose two names")
        seen.add(path.resolve())
        check_writable(path)


def cell(value: Any) -> Any:
    """A value as a cell of a CSV that spreadsheets take for no formula: text like =1+1 begins with an apostrophe."""
    if not isinstance(value, str) or not value.startswith(FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def write_json(path: Path, value: Any) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2) + "\n")
