"""Which files under the given paths are scans."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fmr_cli.errors import FmrError
from fmr_cli.io import SUFFIXES

TABLES = (".txt", ".csv", ".npy", ".npz")  # also poses, calibrations, time stamps


def find_scans(paths: Iterable[Path]) -> list[Path]:
    """The readable files among the paths, folders searched recursively, sorted. Raises FmrError where there are none.

    Tables (.txt, .csv, .npy, .npz) in a folder count as scans only if it holds nothing that surely is one.
    """
    paths, found = list(paths), []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(f for f in path.rglob("*") if f.is_file() and f.suffix.lower() in SUFFIXES)
        sure = [f for f in inside if f.suffix.lower() not in TABLES]
        found += sure or inside
    if not found:
        raise FmrError(f"{', '.join(map(str, paths))}: no scan in there; give files of the kinds {' '.join(SUFFIXES)}")
    return found
