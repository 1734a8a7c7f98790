"""7-Scenes, fused into fragments as in 3DMatch: 7-scenes-NAME/cloud_bin_0.ply ... (Shotton et al. 2013).

Where fragments have poses (cloud_bin_0.info.txt as 3DMatch writes them, or cloud_bin_0.pose.txt), pairs are those that
overlap by 0.3 and do not follow each other, and right is 3DMatch's: a root mean square distance of the correspondences
at the true pose of at most 0.2 m. Else, as in the paper (Huang et al. 2020): each fragment and a copy of it turned by
up to 60 deg and shifted by up to 0.8 m, right below 5 deg and 0.2 m.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.errors import FmrError
from fmr_cli.evaluation.datasets.modelnet40 import motion
from fmr_cli.evaluation.datasets.pair import CorrespondenceRmse, DataSet, Loaded, Pair, Within, information
from fmr_cli.evaluation.datasets.posed import POSE, overlapping
from fmr_cli.evaluation.datasets.redwood import fragment_files, read_fragment
from fmr_cli.evaluation.datasets.threedmatch import RMSE, STEM, VOXEL
from fmr_cli.io import read_transform
from fmr_cli.io.transforms import as_transform

PREFIX = "7-scenes-"
INFO = ".info.txt"  # a line that names the scene and its frames, then the pose
NEAR = 0.05  # m, of a correspondence
ROTATION, SHIFT = 60.0, 0.8  # degrees, m: the paper's
DEGREES, WITHIN = 5.0, 0.2  # m


def recognise(paths: Sequence[Path]) -> bool:
    return any(scenes(path) for path in paths)


def scenes(path: Path) -> list[Path]:
    """The folders of scenes: the path itself, or those in it."""
    folders = [path] if path.resolve().name.startswith(PREFIX) else sorted(path.glob(f"{PREFIX}*"))
    return [folder for folder in folders if folder.is_dir() and fragment_files(folder, STEM)]


def read(paths: Sequence[Path], *, seed: int = 0) -> DataSet:
    """seed: of the motions where there are no poses. Raises FmrError."""
    folders = [folder for path in paths for folder in scenes(path)]
    if not folders:
        raise FmrError(f"{', '.join(map(str, paths))}: no {PREFIX}NAME/{STEM}_0.ply in there")
    posed = {folder: fragments_with_poses(folder) for folder in folders}
    if not any(posed.values()):
        copies = [
            copied(folder.name, file, seed) for folder in folders for file in fragment_files(folder, STEM).values()
        ]
        return DataSet("7-Scenes, moved copies", copies, Within(DEGREES, WITHIN), VOXEL)
    pairs = [with_information(pair) for folder in folders for pair in overlapping(folder.name, posed[folder], apart=2)]
    if not pairs:
        raise FmrError(f"{folders[0]}: no two fragments that do not follow each other overlap at their poses")
    return DataSet("7-Scenes", pairs, CorrespondenceRmse(RMSE), VOXEL, by_scene=True)


def fragments_with_poses(folder: Path) -> list[tuple[Path, np.ndarray]]:
    """Fragments and T_world_fragment (4, 4), of those that have a pose. Raises CloudFileError."""
    found = []
    for file in fragment_files(folder, STEM).values():
        info, pose = file.with_name(file.stem + INFO), file.with_name(file.stem + POSE)
        if info.is_file():
            found.append((file, pose_of_info(info)))
        elif pose.is_file():
            found.append((file, read_transform(pose)))
    return found


def pose_of_info(path: Path) -> np.ndarray:
    """The last four rows of a cloud_bin_I.info.txt: fragment to world."""
    lines = [line for line in path.read_text("utf-8", errors="replace").splitlines() if line.strip()]
    rows = [[float(word) for word in line.split()] for line in lines[-4:]]
    return as_transform(np.array(rows))


def with_information(pair: Pair) -> Pair:
    """The pair with the information of its correspondences: source points within NEAR of the target at the truth."""

    def load() -> Loaded:
        loaded = pair.load()
        moved = transform_points(loaded.T_target_source, loaded.source)
        near = np.isfinite(cKDTree(loaded.target).query(moved, distance_upper_bound=NEAR)[0])
        return replace(loaded, information=information(loaded.source[near])) if near.any() else loaded

    return replace(pair, load=load)


def copied(scene: str, file: Path, seed: int) -> Pair:
    def load() -> Loaded:
        rng = np.random.default_rng((seed, zlib.crc32(f"{scene} {file.stem}".encode())))
        source, T = read_fragment(file), motion(rng, ROTATION, SHIFT)
        return Loaded(source, transform_points(T, source), T)

    return Pair(scene, file.stem, "copy", load)
