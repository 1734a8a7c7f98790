"""ETH: laser scans of woods and a park in summer and winter, as 3DSmoothNet distributes them (Gojcic et al. 2019).

    SCENE/Hokuyo_0.ply ..., SCENE/gt.log, and SCENE/overlapMatrix.csv: then only pairs that overlap by 0.3 count

Right is less than 5 deg and 0.3 m, as in the table that is quoted beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.evaluation.datasets.pair import DataSet, Pair, Within
from fmr_cli.evaluation.datasets.redwood import has_fragments, logs, pairs_of, read_blocks

STEM = "Hokuyo"
DEGREES, SHIFT = 5.0, 0.3  # m
OVERLAP = 0.3  # a pair has at least
VOXEL = 0.1  # m; the scans are sparser than 3DMatch's


def recognise(paths: Sequence[Path]) -> bool:
    return bool(logs(paths)) and has_fragments(paths, STEM)


def read(paths: Sequence[Path], *, seed: int = 0) -> DataSet:
    """Raises FmrError."""
    pairs = [pair for log in logs(paths) for pair in of_scene(log, paths)]
    if not pairs:
        raise FmrError(f"{', '.join(map(str, paths))}: no pair in there; ETH has SCENE/Hokuyo_0.ply and SCENE/gt.log")
    return DataSet("ETH", pairs, Within(DEGREES, SHIFT), VOXEL)


def of_scene(log: Path, paths: Sequence[Path]) -> list[Pair]:
    """The pairs of a scene that overlap enough, where overlapMatrix.csv tells."""
    pairs = pairs_of(log, paths, STEM, False)
    table = log.with_name("overlapMatrix.csv")
    if not table.is_file():
        return pairs
    try:
        overlap = np.genfromtxt(table, delimiter=",")
        enough = [overlap[i, j] > OVERLAP or overlap[j, i] > OVERLAP for i, j in read_blocks(log, 4)]
    except (ValueError, IndexError) as error:
        raise CloudFileError(f"{table}: is no matrix of the overlaps of {log.name} ({error})") from None
    return [pair for pair, counts in zip(pairs, enough, strict=True) if counts]
