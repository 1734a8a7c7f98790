"""The true poses of a sequence: KITTI, TUM and .npy files, and which frame each pose belongs to."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.io import read_poses
from fmr_cli.io.files import check_readable, reason
from fmr_cli.io.folders import EPOCH_DIGITS
from fmr_cli.io.transforms import as_transform, number_rows

KITTI_ROW, TUM_ROW = (12, 16), 8  # numbers a line
ACROSS = 3.0  # usual steps between known times: a longer gap, as GNSS has in a tunnel, is not interpolated across
ROUNDING = 0.01  # usual steps: times so near to each other are one, written with fewer digits


@dataclass(frozen=True)
class Truth:
    """True poses (k, 4, 4) and the frames (k,), growing, that they belong to.

    A number of a frame that is not whole lies between two frames. note: what a person should know of the choice, or "".
    """

    poses: np.ndarray
    frames: np.ndarray
    note: str = ""

    def beside(self, path: np.ndarray) -> np.ndarray:
        """A path's own poses (k, 4, 4) at those frames; path (n, 4, 4): a pose a frame."""
        return between(path, np.arange(len(path)), self.frames)


def read_truth(path: Path, chosen: range, total: int, times: np.ndarray | None = None) -> Truth:
    """The true poses of the chosen scans: KITTI rows, TUM rows, or .npy of (m, 4, 4), (m, 3, 4) or (m, 12).

    A file has a row for each chosen scan, or for all ``total``. TUM rows have times of their own: where the chosen
    scans have theirs too (n,), seconds, they are matched by time, and there may be as many as there are.
    Raises FmrError where rows and scans don't match, or evo or matplotlib is not installed.
    """
    missing = [name for name in ("evo", "matplotlib") if importlib.util.find_spec(name) is None]
    if missing:
        raise FmrError(f"--truth needs {' and '.join(missing)}: pip install 'fmr-cli[eval]'")
    poses, stamps = read_trajectory(path)
    poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()  # exact ones, of files with few digits too
    if stamps is not None and times is not None:
        return matched(path, poses, stamps, times)
    if len(poses) == total:
        poses = poses[np.array(chosen)]
    if len(poses) != len(chosen):
        remedy = "give a row for each scan" if stamps is None else "and the scans have no times to match by"
        raise FmrError(f"{path}: {len(poses)} poses for {len(chosen)} scans, {remedy}")
    return Truth(poses, np.arange(len(poses), dtype=float))


def read_trajectory(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Poses (m, 4, 4) of a file, and their times (m,), seconds, where they are TUM rows. Raises CloudFileError."""
    check_readable(path)
    if path.suffix.lower() == ".npy":
        return poses_of_array(path), None
    try:
        rows = list(number_rows(path))
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}; true poses are KITTI rows, TUM rows, or .npy") from None
    lengths = {len(row) for row in rows}
    if lengths == {TUM_ROW}:
        return poses_of_tum(path, np.array(rows))
    if lengths - set(KITTI_ROW):
        said = " and ".join(map(str, sorted(lengths)[:3]))
        raise CloudFileError(f"{path}: has {said} numbers a line; KITTI has 12, TUM 8 (time x y z qx qy qz qw)")
    return read_poses(path), None


def poses_of_array(path: Path) -> np.ndarray:
    """(n, 4, 4) of a .npy file."""
    try:
        values = np.load(path, allow_pickle=False).astype(np.float64)
        values = values.reshape(len(values), *{12: (3, 4), 16: (4, 4)}[values[0].size])
    except Exception as error:
        said = "its shape is another" if isinstance(error, KeyError | IndexError | TypeError) else reason(error)
        raise CloudFileError(f"{path}: is no array of poses ({said}), expected (n, 4, 4), (n, 3, 4), (n, 12)") from None
    try:
        return np.stack([as_transform(T) for T in values])
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}") from None


def poses_of_tum(path: Path, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (m, 4, 4) and times (m,), seconds, of a table (m, 8)."""
    stamps, length = table[:, 0], np.linalg.norm(table[:, 4:], axis=1)
    if not np.isfinite(table).all() or not (length > 0).all() or not (np.diff(stamps) > 0).all():
        raise CloudFileError(f"{path}: its times must grow and its quaternions not be 0, as TUM has them")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    # TUM's are seconds; some write ms, us or ns since 1970, which the names of scans are read as too
    return poses, stamps / 10.0 ** EPOCH_DIGITS.get(len(str(int(stamps[0]))), 0)


def matched(path: Path, poses: np.ndarray, stamps: np.ndarray, times: np.ndarray) -> Truth:
    """Poses (m, 4, 4) known at ``stamps`` (m,) and frames taken at ``times`` (n,), as far as they are of one time.

    What is denser in time is interpolated at the times of the other: between true poses seconds apart lies no truth.
    """
    order = np.argsort(times, kind="stable")  # a drive may be told backwards
    if usual_step(stamps) <= usual_step(times[order]):
        frames = np.flatnonzero(known(stamps, times)).astype(float)
        poses = between(poses, stamps, times[frames.astype(int)])
        some = f"{len(frames)} of {len(times)} frames have a true pose at their time, the others are not compared"
    else:
        near = known(times[order], stamps)
        frames = np.interp(stamps[near], times[order], order.astype(float))
        poses, frames = poses[near][np.argsort(frames)], np.sort(frames)
        some = f"{len(frames)} true poses among {len(times)} frames, the path is compared at their times"
    if len(frames) < 2:
        raise FmrError(
            f"{path}: its times run from {stamps[0]:.9g} to {stamps[-1]:.9g}, the scans' from {times.min():.9g} to "
            f"{times.max():.9g}; fewer than two poses are of one time"
        )
    return Truth(poses, frames, f"{path}: {some}" if len(frames) < len(times) else "")


def usual_step(times: np.ndarray) -> float:
    """Between neighbours of times (n,), seconds; endless where there is one alone."""
    return float(np.median(np.diff(times))) if len(times) > 1 else np.inf


def known(stamps: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n,): which of the times ``at`` (n,) lie on a stamp (m,), growing, or between two neighbours that are no gap."""
    step = usual_step(stamps)
    after = np.searchsorted(stamps, at).clip(1, len(stamps) - 1)
    on_one = np.minimum(np.abs(at - stamps[after - 1]), np.abs(at - stamps[after])) <= ROUNDING * step
    within = (stamps[0] <= at) & (at <= stamps[-1]) & (stamps[after] - stamps[after - 1] <= ACROSS * step)
    return on_one | within


def between(poses: np.ndarray, stamps: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses (m, 4, 4) known at ``stamps`` (m,), at others (n,): shifts linear, turns on the shortest way.

    Before the first stamp and after the last one the pose is theirs.
    """
    at = np.clip(at, stamps[0], stamps[-1])
    found = np.tile(np.eye(4), (len(at), 1, 1))
    found[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    found[:, :3, 3] = np.stack([np.interp(at, stamps, axis) for axis in poses[:, :3, 3].T], 1)
    return found
