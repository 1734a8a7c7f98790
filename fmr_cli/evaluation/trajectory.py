"""How far a trajectory is from the truth: KITTI's segment errors; absolute and relative errors, by evo; and a plot."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.io import read_poses
from fmr_cli.io.files import check_readable
from fmr_cli.io.transforms import as_transform, number_rows

KITTI_LENGTHS = tuple(range(100, 801, 100))  # m, of the segments; from KITTI's odometry devkit, as is the next
KITTI_STEP = 10  # frames between the starts of segments: one second
TENTHS = tuple(range(1, 9))  # of a path shorter than KITTI's segments: its own segments' lengths


def read_truth(path: Path, chosen: range, total: int, times: np.ndarray | None = None) -> np.ndarray:
    """(n, 4, 4) true poses of the chosen scans: KITTI rows, TUM rows, or .npy of (m, 4, 4), (m, 3, 4) or (m, 12).

    A file has a row for each chosen scan, or for all ``total``. TUM rows have times of their own: where the chosen
    scans have theirs too (n,), seconds, poses are interpolated at them.
    Raises FmrError where the number of rows is another or a time lies outside, or evo or matplotlib is not installed.
    """
    missing = [name for name in ("evo", "matplotlib") if importlib.util.find_spec(name) is None]
    if missing:
        raise FmrError(f"--truth needs {' and '.join(missing)}: pip install 'fmr-cli[eval]'")
    poses, stamps = read_trajectory(path)
    if stamps is not None and times is not None:
        return at_times(path, poses, stamps, times)
    if len(poses) == total:
        return poses[np.array(chosen)]
    if len(poses) != len(chosen):
        raise FmrError(f"{path}: {len(poses)} poses for {len(chosen)} scans, give a row for each scan")
    return poses


def read_trajectory(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Poses (m, 4, 4) of a file, and their times (m,), seconds, where they are TUM rows. Raises CloudFileError."""
    check_readable(path)
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, allow_pickle=False).astype(np.float64)
            values = values.reshape(len(values), *{12: (3, 4), 16: (4, 4)}[values[0].size])
        except (ValueError, KeyError, TypeError, IndexError, EOFError) as error:
            raise CloudFileError(f"{path}: is no array of poses ({error}), expected (n, 4, 4) or (n, 12)") from None
        return np.stack([as_transform(T) for T in values]), None
    try:
        rows = list(number_rows(path))
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}") from None
    if {len(row) for row in rows} != {8}:
        return read_poses(path), None
    table = np.array(rows)
    length = np.linalg.norm(table[:, 4:], axis=1)
    if not np.isfinite(table).all() or not (length > 0).all() or not (np.diff(table[:, 0]) > 0).all():
        raise CloudFileError(f"{path}: its times must grow and its quaternions not be 0, as TUM has them")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return poses, table[:, 0]


def at_times(path: Path, poses: np.ndarray, stamps: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Poses (m, 4, 4) known at ``stamps`` (m,), at ``times`` (n,): shifts linear, turns on the shortest way."""
    slack = float(np.median(np.diff(stamps))) / 2 if len(stamps) > 1 else 0.0
    outside = np.flatnonzero((times < stamps[0] - slack) | (times > stamps[-1] + slack))
    if len(outside) or len(stamps) < 2:
        raise FmrError(
            f"{path}: its times run from {stamps[0]:.9g} to {stamps[-1]:.9g}, {len(outside)} of {len(times)} scans lie "
            f"outside (from {times.min():.9g} to {times.max():.9g}); choose scans by --start and --stop"
        )
    times = np.clip(times, stamps[0], stamps[-1])
    found = np.tile(np.eye(4), (len(times), 1, 1))
    found[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
    found[:, :3, 3] = np.stack([np.interp(times, stamps, axis) for axis in poses[:, :3, 3].T], 1)
    return found


@dataclass(frozen=True)
class Segments:
    """Errors of n segments of a path, each from its own start. length (n,): in the poses' unit, as it was asked for.

    translation (n,): how far off the segment's end is, over its length. rotation (n,): degrees over its length.
    """

    length: np.ndarray
    translation: np.ndarray
    rotation: np.ndarray

    def means(self) -> tuple[float, float]:
        """Over all segments: translation in percent, rotation in degrees per 100 units."""
        return float(self.translation.mean() * 100), float(self.rotation.mean() * 100)


def segment_errors(poses: np.ndarray, truth: np.ndarray, lengths: Sequence[float], step: int) -> Segments:
    """Errors of poses (n, 4, 4) against the truth (n, 4, 4) over segments, as KITTI's odometry devkit defines them.

    Every ``step``-th frame starts a segment of each length, which ends at the first frame that is further than that
    along the true path; there is none where the path ends before.
    """
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).cumsum()])
    starts, asked = (x.ravel() for x in np.meshgrid(np.arange(0, len(truth), step), lengths, indexing="ij"))
    ends = np.searchsorted(along, along[starts] + asked, side="right")
    starts, ends, asked = (x[ends < len(truth)] for x in (starts, ends, asked))
    found, true = (np.linalg.inv(path[starts]) @ path[ends] for path in (poses, truth))
    degrees, shift = pose_error(found, true)
    return Segments(asked.astype(float), shift / asked, degrees / asked)


def evaluate(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Errors of poses (n, 4, 4); lengths in the poses' unit.

    kitti: whether the segments are KITTI's, of 100 to 800, or, of a path shorter than 100, a tenth to eight tenths of
    it, from every frame. translation_percent, deg_per_100: means over all segments, None where there is none;
    segments: the means by length. ape_rmse_first_pose: of positions, both first poses made to coincide, so that an
    error of the first heading counts at every frame; rpe_*: from frame to frame.
    """
    from evo.core.metrics import APE, RPE, PoseRelation
    from evo.core.trajectory import PosePath3D

    found, true = (PosePath3D(poses_se3=list(np.linalg.inv(path[0]) @ path)) for path in (poses, truth))

    def rmse(metric: Any) -> float:
        metric.process_data((true, found))
        return float(np.sqrt(np.mean(metric.error**2)))

    length = float(true.path_length)
    kitti = length > KITTI_LENGTHS[0]
    lengths = KITTI_LENGTHS if kitti else [tenths / 10 * length for tenths in TENTHS]
    segments = segment_errors(poses, truth, lengths, KITTI_STEP if kitti else 1)
    means = segments.means() if len(segments.length) else (None, None)
    return {
        "frames": len(poses),
        "length": length,
        "kitti": kitti,
        "segments": [by_length(segments, each) for each in np.unique(segments.length)],
        "translation_percent": means[0],
        "deg_per_100": means[1],
        "ape_rmse_first_pose": rmse(APE(PoseRelation.translation_part)),
        "rpe_translation_rmse": rmse(RPE(PoseRelation.translation_part)),
        "rpe_rotation_deg_rmse": rmse(RPE(PoseRelation.rotation_angle_deg)),
        "end_drift_percent": float(np.linalg.norm(found.positions_xyz[-1] - true.positions_xyz[-1]) / length * 100),
    }


def by_length(segments: Segments, length: float) -> dict[str, float]:
    """The means over the segments of one length."""
    here = segments.length == length
    own = Segments(segments.length[here], segments.translation[here], segments.rotation[here])
    translation, rotation = own.means()
    return {"length": float(length), "count": int(here.sum()), "translation_percent": translation,
            "deg_per_100": rotation}  # fmt: skip


def summary(errors: dict[str, Any]) -> list[str]:
    """What ``evaluate`` found, for a person."""
    lines = []
    if errors["segments"]:
        first, last = errors["segments"][0]["length"], errors["segments"][-1]["length"]
        lines.append(
            f"{'KITTI ' if errors['kitti'] else ''}segments of {first:.3g} to {last:.3g}: "
            f"{errors['translation_percent']:.3f} %, {errors['deg_per_100']:.3f} deg/100"
        )
    lines.append(
        f"APE from the first pose {errors['ape_rmse_first_pose']:.4g}, RPE {errors['rpe_translation_rmse']:.4g} and "
        f"{errors['rpe_rotation_deg_rmse']:.4g} deg a frame, end drift {errors['end_drift_percent']:.3f} %"
    )
    return lines
