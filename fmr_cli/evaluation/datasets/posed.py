"""Scans with poses in a folder: NAME.pose.txt beside each, or poses.txt with a KITTI row for each in natural order.

A pose takes its scan to a common frame. Pairs are those of which each overlaps the other by 0.3. Right is a rotation of
less than 5 deg off, and the source's mean less than 2 % of its diagonal off: no unit is assumed, and the origin does
not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.evaluation.datasets.pair import DataSet, Loaded, Pair, Within
from fmr_cli.io import SUFFIXES, read_cloud, read_poses, read_transform
from fmr_cli.io.folders import natural
from fmr_cli.synthetic.sensors import overlap

POSE = ".pose.txt"
POSES = "poses.txt"
LEAST = 0.3  # overlap of a pair, as 3DMatch has it
DEGREES, SHARE = 5.0, 0.02
LOOKED_AT = 50_000  # points of a scan that the overlap is found from
TEXT = (".txt", ".csv")


def recognise(paths: Sequence[Path]) -> bool:
    return any(path.is_dir() and ((path / POSES).is_file() or next(path.glob(f"*{POSE}"), None)) for path in paths)


def read(paths: Sequence[Path], *, seed: int = 0) -> DataSet:
    """Raises FmrError."""
    pairs = [pair for path in paths for pair in overlapping(path.resolve().name, scans_with_poses(path))]
    if not pairs:
        raise FmrError(f"{', '.join(map(str, paths))}: no two scans overlap by {LEAST:g} at their poses")
    return DataSet("poses", pairs, Within(DEGREES, share=SHARE, centred=True), centred=True)


def scans_with_poses(folder: Path) -> list[tuple[Path, np.ndarray]]:
    """The scans of a folder in natural order with T_world_scan (4, 4). Raises CloudFileError."""
    if not folder.is_dir():
        raise CloudFileError(f"{folder}: is no folder of scans and poses")
    scans = [f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.endswith((POSE, POSES))]
    scans = sorted([f for f in scans if f.suffix.lower() not in TEXT] or scans, key=lambda file: natural(file.name))
    if (folder / POSES).is_file():
        poses = read_poses(folder / POSES)
        if len(poses) != len(scans):
            raise CloudFileError(
                f"{folder / POSES}: {len(poses)} poses for {len(scans)} scans, give a row for each scan"
            )
        return list(zip(scans, poses, strict=True))
    beside = [(file, file.with_name(file.stem + POSE)) for file in scans]
    return [(file, read_transform(pose)) for file, pose in beside if pose.is_file()]


def overlapping(scene: str, scans: Sequence[tuple[Path, np.ndarray]], apart: int = 1) -> list[Pair]:
    """Pairs of scans, at least ``apart`` places from each other, of which each overlaps the other by LEAST."""
    seen = [transform_points(T, read_cloud(file, attributes=False, at_most=LOOKED_AT).points) for file, T in scans]
    boxes = [(points.min(0), points.max(0)) for points in seen]
    pairs = []
    for i, j in combinations(range(len(scans)), 2):
        apart_in_space = (boxes[i][0] > boxes[j][1]).any() or (boxes[j][0] > boxes[i][1]).any()
        if j - i >= apart and not apart_in_space and min(overlap(seen[j], seen[i])) >= LEAST:
            (target, T_world_target), (source, T_world_source) = scans[i], scans[j]
            T = np.linalg.inv(T_world_target) @ T_world_source
            pairs.append(Pair(scene, source.name, target.name, loader(source, target, T)))
    return pairs


def loader(source: Path, target: Path, T_target_source: np.ndarray) -> Callable[[], Loaded]:
    def load() -> Loaded:
        moving, fixed = (read_cloud(file, attributes=False).points for file in (source, target))
        return Loaded(moving, fixed, T_target_source)

    return load
