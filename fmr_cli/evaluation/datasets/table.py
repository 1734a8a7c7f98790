"""Pairs of one's own with their transforms: a CSV file with the columns source, target, transform, optionally scene.

transform: T_target_source, a file or 12 numbers; paths are relative to the CSV file. Right is as of a folder of scans
with poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fmr_cli.errors import FmrError
from fmr_cli.evaluation.datasets.pair import DataSet, Pair, Within
from fmr_cli.evaluation.datasets.posed import DEGREES, SHARE, loader
from fmr_cli.multiway.known import rows, transform


def recognise(paths: Sequence[Path]) -> bool:
    return len(paths) == 1 and paths[0].suffix.lower() == ".csv" and "transform" in first_line(paths[0])


def first_line(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return file.readline()


def read(paths: Sequence[Path], *, seed: int = 0) -> DataSet:
    """Raises FmrError."""
    pairs = []
    for path in paths:
        if path.is_dir():
            raise FmrError(f"{path}: is a folder, give the CSV file that lists the pairs")
        for number, row in rows(path, {"source", "target", "transform"}):
            T = transform(row["transform"], path.parent, f"{path}: line {number}")
            source, target = path.parent / row["source"], path.parent / row["target"]
            pairs.append(Pair(row.get("scene") or path.stem, row["source"], row["target"], loader(source, target, T)))
    return DataSet("pairs", pairs, Within(DEGREES, share=SHARE, centred=True), centred=True)
