"""Which files under the given paths are scans, in which order, and the times that their names tell."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from fmr_cli.errors import FmrError
from fmr_cli.io import SUFFIXES, holds_scans, scan_paths

# A decimal number, but no part of 1.2.3; or a whole one. Only ASCII: other digits (circled, superscript) are letters.
NUMBER = re.compile(r"(?<![0-9.])([0-9]+\.[0-9]+)(?!\.?[0-9])|([0-9]+)")
TIME = re.compile(r"(?P<prefix>.*?)(?P<seconds>[0-9]+)(?:(?P<mark>[._])(?P<fraction>[0-9]+))?", re.DOTALL)
# Digits of a whole number that counts units since 1970 (dates from 2001 to 2286), and how many units a second has.
EPOCH_DIGITS = {10: 0, 13: 3, 16: 6, 19: 9}
ROS_DIGITS = (10, 9)  # of seconds_nanoseconds
TABLES = (".txt", ".csv", ".npy", ".npz")  # also poses, calibrations, time stamps


def find_scans(paths: Iterable[Path]) -> list[Path]:
    """The readable files among the paths, folders searched recursively, sorted. Raises FmrError where there are none.

    A file that is given and holds several scans (a bag, an E57, a PTX) is all of them: FILE#1, FILE#2 and so on.
    Tables (.txt, .csv, .npy, .npz) in a folder count as scans only if it holds nothing that surely is one.
    """
    paths, found = list(paths), []
    for path in paths:
        if holds_scans(path):
            found += scan_paths(path)
            continue
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(f for f in path.rglob("*") if f.is_file() and f.suffix.lower() in SUFFIXES)
        sure = [f for f in inside if f.suffix.lower() not in TABLES]
        found += sure or inside
    if not found:
        raise FmrError(f"{', '.join(map(str, paths))}: no scan in there; give files of the kinds {' '.join(SUFFIXES)}")
    return found


def stem(path: Path) -> str:
    """The file's name without what says its format: 102.05 of 102.05.ply, 7 of 7.pcd.bin."""
    name = path.name
    while ending := next((suffix for suffix in SUFFIXES if name.lower().endswith(suffix) and name != suffix), ""):
        name = name[: -len(ending)]
    return name


def natural(name: str) -> tuple[list[tuple[int, int | Decimal, str]], str]:
    """A key that puts scan2 before scan10, and 102.05 between 102.0 and 102.1; of a name without its suffix."""
    parts: list[tuple[int, int | Decimal, str]] = []
    end = 0
    for found in NUMBER.finditer(name):
        if found.start() > end:
            parts.append((1, 0, name[end : found.start()].casefold()))
        parts.append((0, Decimal(found[1]) if found[1] else int(found[2]), ""))
        end = found.end()
    return ([*parts, (1, 0, name[end:].casefold())] if end < len(name) else parts), name


def times_by_name(names: Sequence[str]) -> np.ndarray | None:
    """(n,), seconds, where all names (without suffixes) end in a time; None where they don't.

    A time is a decimal number of seconds, seconds_nanoseconds as in ROS, or a whole number of s, ms, us or ns since
    1970, told by its length. Other whole numbers only count the files. What stands before it must be the same in all.
    """
    found = [TIME.fullmatch(name) for name in names]
    if not found or any(match is None for match in found) or len({match["prefix"] for match in found if match}) > 1:
        return None
    times, surely = [], False
    for match in found:
        assert match
        whole, mark, fraction = match["seconds"], match["mark"], match["fraction"]
        if mark == "." or (mark == "_" and (len(whole), len(fraction)) == ROS_DIGITS):
            times.append(float(f"{whole}.{fraction}"))
            surely = True
        elif mark is None:
            surely |= is_epoch(whole)
            times.append(float(Decimal(whole).scaleb(-EPOCH_DIGITS[len(whole)] if is_epoch(whole) else 0)))
        else:
            return None
    return np.array(times) if surely else None


def is_epoch(digits: str) -> bool:
    """Whether a whole number counts units since 1970; zeros before it pad the number of a file."""
    return len(digits) in EPOCH_DIGITS and digits[0] != "0"
