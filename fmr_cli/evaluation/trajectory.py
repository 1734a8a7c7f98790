"""How far a trajectory is from the truth: KITTI's segment errors; absolute and relative errors, by evo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmr_cli.geometry.pose_error import pose_error

KITTI_LENGTHS = tuple(range(100, 801, 100))  # m, of the segments; from KITTI's odometry devkit, as is the next
KITTI_STEP = 10  # frames between the starts of segments: one second
TENTHS = tuple(range(1, 9))  # of a path shorter than KITTI's segments: its own segments' lengths


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


def path_segments(poses: np.ndarray, truth: np.ndarray) -> tuple[bool, Segments]:
    """Whether KITTI's segments fit into the true path (n, 4, 4), and the errors of those, else of ones that do.

    KITTI's are of 100 to 800; of a path shorter than 100 they are a tenth to eight tenths of it, from every frame.
    """
    length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    if length > KITTI_LENGTHS[0]:
        return True, segment_errors(poses, truth, KITTI_LENGTHS, KITTI_STEP)
    return False, segment_errors(poses, truth, [tenths / 10 * length for tenths in TENTHS], 1)


def evaluate(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Errors of poses (n, 4, 4); lengths in the poses' unit.

    kitti, segments: of ``path_segments``, the means by length. translation_percent, deg_per_100: means over all
    segments, None where there is none. ape_rmse_first_pose: of positions, both first poses made to coincide, so that
    an error of the first heading counts at every frame; rpe_*: from frame to frame. end_drift_percent: of the true
    path's length, None where that is 0.
    """
    from evo.core.metrics import APE, RPE, PoseRelation
    from evo.core.trajectory import PosePath3D

    found, true = (PosePath3D(poses_se3=list(np.linalg.inv(path[0]) @ path)) for path in (poses, truth))

    def rmse(metric: Any) -> float:
        metric.process_data((true, found))
        return float(np.sqrt(np.mean(metric.error**2)))

    length = float(true.path_length)
    kitti, segments = path_segments(poses, truth)
    means = segments.means() if len(segments.length) else (None, None)
    end = float(np.linalg.norm(found.positions_xyz[-1] - true.positions_xyz[-1]))
    return {
        "frames": len(poses),
        "length": length,
        "kitti": kitti,
        "segments": by_length(segments),
        "translation_percent": means[0],
        "deg_per_100": means[1],
        "ape_rmse_first_pose": rmse(APE(PoseRelation.translation_part)),
        "rpe_translation_rmse": rmse(RPE(PoseRelation.translation_part)),
        "rpe_rotation_deg_rmse": rmse(RPE(PoseRelation.rotation_angle_deg)),
        "end_drift_percent": end / length * 100 if length else None,
    }


def by_length(segments: Segments) -> list[dict[str, float]]:
    """The means over the segments of each length."""
    rows = []
    for length in np.unique(segments.length):
        here = segments.length == length
        own = Segments(segments.length[here], segments.translation[here], segments.rotation[here])
        translation, rotation = own.means()
        rows.append({"length": float(length), "count": int(here.sum()), "translation_percent": translation,
                     "deg_per_100": rotation})  # fmt: skip
    return rows


def summary(errors: dict[str, Any]) -> list[str]:
    """What ``evaluate`` found, for a person."""
    lines = []
    if errors["segments"]:
        first, last = errors["segments"][0]["length"], errors["segments"][-1]["length"]
        lines.append(
            f"{'KITTI ' if errors['kitti'] else ''}segments of {first:.3g} to {last:.3g}: "
            f"{errors['translation_percent']:.3f} %, {errors['deg_per_100']:.3f} deg/100"
        )
    drift = errors["end_drift_percent"]
    lines.append(
        f"APE from the first pose {errors['ape_rmse_first_pose']:.4g}, RPE {errors['rpe_translation_rmse']:.4g} and "
        f"{errors['rpe_rotation_deg_rmse']:.4g} deg a frame" + ("" if drift is None else f", end drift {drift:.3f} %")
    )
    return lines
