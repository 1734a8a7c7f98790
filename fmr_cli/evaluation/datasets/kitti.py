"""KITTI odometry, pairs 10 m apart (Yew and Lee 2018, Choy et al. 2019).

    [dataset/]sequences/08/velodyne/000000.bin ..., sequences/08/calib.txt, poses/08.txt
    or one sequence: velodyne/, calib.txt, poses.txt

From a scan on, the pair ends at the last one that is not further than 10 m; the next pair begins after it. Sequences
08, 09 and 10 where they are there, else all. KITTI's own poses (GPS) are off by decimetres over 10 m, so that the truth
is where point-to-point ICP goes from them, as in FCGF and those after it. Right is less than 5 deg and 2 m; the errors
are means over what is right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.evaluation.datasets.pair import DataSet, Loaded, Pair, Within
from fmr_cli.io import read_cloud, read_poses
from fmr_cli.sequence.scans import read_calibration

DEGREES, SHIFT = 5.0, 2.0  # m
APART = 10.0  # m
LOOK = 100  # scans ahead at most
TEST = ("08", "09", "10")
WRONG = ("08", 15, 58)  # its truth is; Predator, D3Feat and those after them leave it out
VOXEL = 0.3  # m, of FCGF on KITTI
ICP_VOXEL, ICP_REACH, ICP_ITERATIONS = 0.05, 0.2, 200  # m, m; FCGF's


def recognise(paths: Sequence[Path]) -> bool:
    return any(sequences(path) for path in paths)


def sequences(path: Path) -> list[tuple[str, Path, Path]]:
    """(name, folder with velodyne/, file of poses) of each sequence that has both."""
    if (path / "velodyne").is_dir() and (path / "poses.txt").is_file():
        return [(path.resolve().name, path, path / "poses.txt")]
    root = next((r for r in (path, path / "dataset") if (r / "sequences").is_dir()), None)
    if root is None:
        return []
    found = [(f.name, f, root / "poses" / f"{f.name}.txt") for f in sorted((root / "sequences").iterdir())]
    return [
        (name, folder, poses) for name, folder, poses in found if (folder / "velodyne").is_dir() and poses.is_file()
    ]


def read(paths: Sequence[Path], *, seed: int = 0) -> DataSet:
    """Raises FmrError."""
    found = [sequence for path in paths for sequence in sequences(path)]
    if not found:
        raise FmrError(
            f"{', '.join(map(str, paths))}: no sequence with poses in there; KITTI has sequences/08/velodyne/ and "
            "poses/08.txt"
        )
    test = [sequence for sequence in found if sequence[0] in TEST]
    chosen = test if {name for name, *_ in test} == set(TEST) else found
    pairs = [pair for sequence in chosen for pair in of_sequence(*sequence)]
    if not pairs:
        raise FmrError(f"{chosen[0][1]}: no two scans are {APART:g} m apart")
    return DataSet("KITTI", pairs, Within(DEGREES, SHIFT), VOXEL)


def of_sequence(name: str, folder: Path, poses_file: Path) -> list[Pair]:
    """The pairs of a sequence; the poses are those of the left camera, which calib.txt takes to the scanner."""
    T_camera_scan = read_calibration(folder)
    if T_camera_scan is None:
        raise CloudFileError(f"{folder / 'calib.txt'}: is not there or has no Tr, which the camera's poses need")
    T_world_scan = read_poses(poses_file) @ T_camera_scan
    scans = {int(file.stem): file for file in (folder / "velodyne").glob("*.bin") if file.stem.isdecimal()}
    chosen = [(i, j) for i, j in ten_metres(T_world_scan[:, :3, 3]) if i in scans and j in scans]
    return [
        Pair(
            name,
            scans[i].stem,
            scans[j].stem,
            loader(scans[i], scans[j], np.linalg.inv(T_world_scan[j]) @ T_world_scan[i]),
        )
        for i, j in chosen
        if (name, i, j) != WRONG
    ]


def ten_metres(positions: np.ndarray) -> list[tuple[int, int]]:
    """The pairs along positions (n, 3): each ends just before the first scan that is more than APART away."""
    pairs, i = [], 0
    while i < len(positions):
        far = np.flatnonzero(np.linalg.norm(positions[i : i + LOOK] - positions[i], axis=1) > APART)
        if len(far) == 0:
            i += 1
            continue
        j = i + int(far[0]) - 1
        pairs.append((i, j))
        i = j + 1
    return [(i, j) for i, j in pairs if j > i]


def loader(source: Path, target: Path, T_gps: np.ndarray) -> Callable[[], Loaded]:
    def load() -> Loaded:
        s, t = (
            read_cloud(file, attributes=False, bin_columns=("x", "y", "z", "intensity")).points
            for file in (source, target)
        )
        return Loaded(s, t, refined(s, t, T_gps))

    return load


def refined(source: np.ndarray, target: np.ndarray, T_target_source: np.ndarray) -> np.ndarray:
    """Where point-to-point ICP goes from a pose, with FCGF's numbers."""
    import small_gicp

    return np.asarray(
        small_gicp.align(
            target, source, T_target_source, registration_type="ICP", downsampling_resolution=ICP_VOXEL,
            max_correspondence_distance=ICP_REACH, max_iterations=ICP_ITERATIONS, num_threads=1,
        ).T_target_source
    )  # fmt: skip
