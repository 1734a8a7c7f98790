"""3DMatch and 3DLoMatch: fragments of indoor scenes, gt.log and gt.info a scene (Zeng et al. 2017, Huang et al. 2021).

    SCENE/cloud_bin_0.ply ...            fragments (.ply, or Predator's .pth)
    SCENE-evaluation/gt.log, gt.info     beside them, or SCENE/gt.log anywhere below the folders given

Right is a root mean square distance of the true correspondences of at most 0.2 m, on pairs that do not follow each
other; recall is the mean over the scenes, the errors are means over the scenes of the medians of what is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fmr_cli.errors import FmrError
from fmr_cli.evaluation.datasets.pair import CorrespondenceRmse, DataSet
from fmr_cli.evaluation.datasets.redwood import has_fragments, logs, pairs_of, read_blocks

STEM = "cloud_bin"
RMSE = 0.2  # m
VOXEL = 0.05  # m, which FPFH and its peers are given on 3DMatch
NAMES = {"3dmatch": "3DMatch", "3dlomatch": "3DLoMatch"}


def recognise(paths: Sequence[Path]) -> bool:
    return bool(logs(paths)) and has_fragments(paths, STEM)


def read(paths: Sequence[Path], *, seed: int = 0, benchmark: str = "3dmatch") -> DataSet:
    """benchmark: "3dmatch" or "3dlomatch"; the folders may hold the ground truth of both. Raises FmrError."""
    name = NAMES[benchmark]
    found = logs(paths)
    low = [log for log in found if "3dlomatch" in str(log).lower()]
    high = [log for log in found if log not in low]
    chosen = (low or high) if benchmark == "3dlomatch" else (high or low)
    if not chosen:
        raise FmrError(f"{', '.join(map(str, paths))}: no gt.log in there; {name} has one in each SCENE-evaluation/")
    pairs = []
    for log in chosen:
        apart = [j - i > 1 for i, j in read_blocks(log, 4)]  # those that follow each other are not counted
        pairs += [pair for pair, counts in zip(pairs_of(log, paths, STEM, True), apart, strict=True) if counts]
    if not pairs:
        raise FmrError(f"{chosen[0]}: lists no pair of fragments that do not follow each other, none is counted")
    return DataSet(name, pairs, CorrespondenceRmse(RMSE), VOXEL, by_scene=True)
