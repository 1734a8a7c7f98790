"""How far a trajectory is from the truth: KITTI's segment errors, absolute and relative errors, by evo; and a plot."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import FmrError
from fmr_cli.io import read_poses
from fmr_cli.io.files import atomic_write

KITTI_LENGTHS = tuple(range(100, 801, 100))  # m


def read_truth(path: Path, chosen: range, total: int) -> np.ndarray:
    """(n, 4, 4) true poses of the chosen scans, by a file with a row for each of them, or for all ``total``.

    Raises FmrError where the number of rows is another, or evo or matplotlib is not installed.
    """
    missing = [name for name in ("evo", "matplotlib") if importlib.util.find_spec(name) is None]
    if missing:
        raise FmrError(f"--truth needs {' and '.join(missing)}: pip install 'fmr-cli[eval]'")
    poses = read_poses(path)
    if len(poses) == total:
        return poses[np.array(chosen)]
    if len(poses) != len(chosen):
        raise FmrError(f"{path}: {len(poses)} poses for {len(chosen)} scans, give a row for each scan")
    return poses


def evaluate(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Errors of poses (n, 4, 4) after both first frames are made to coincide; lengths in the poses' unit.

    segments: mean translation error (%) and rotation error (deg per 100 units) over all segments of KITTI's lengths
    100 to 800, or of a tenth to eight tenths of a path that is shorter than 100.
    """
    from evo.core.filters import FilterException
    from evo.core.metrics import APE, RPE, PoseRelation, Unit
    from evo.core.trajectory import PosePath3D

    found, true = (PosePath3D(poses_se3=list(np.linalg.inv(path[0]) @ path)) for path in (poses, truth))

    def rmse(metric: Any) -> float:
        metric.process_data((true, found))
        return float(np.sqrt(np.mean(metric.error**2)))

    length = float(true.path_length)
    lengths = [s for s in KITTI_LENGTHS if s < length] if length > KITTI_LENGTHS[0] else np.arange(1, 9) / 10 * length
    segments = []
    for segment in lengths:
        errors = []
        for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
            metric = RPE(relation, delta=segment, delta_unit=Unit.meters, rel_delta_tol=0.1, all_pairs=True)
            try:
                metric.process_data((true, found))
            except FilterException:  # no two frames are so far apart, to a tenth
                break
            errors.append(float(np.mean(metric.error)) * 100 / segment)
        if len(errors) == 2:
            segments.append({"length": float(segment), "translation_percent": errors[0], "deg_per_100": errors[1]})
    return {
        "frames": len(poses),
        "length": length,
        "segments": segments,
        "translation_percent": float(np.mean([s["translation_percent"] for s in segments])) if segments else None,
        "deg_per_100": float(np.mean([s["deg_per_100"] for s in segments])) if segments else None,
        "ate_rmse": rmse(APE(PoseRelation.translation_part)),
        "rpe_translation_rmse": rmse(RPE(PoseRelation.translation_part)),
        "rpe_rotation_deg_rmse": rmse(RPE(PoseRelation.rotation_angle_deg)),
        "end_drift_percent": float(np.linalg.norm(found.positions_xyz[-1] - true.positions_xyz[-1]) / length * 100),
    }


def summary(errors: dict[str, Any]) -> list[str]:
    """What ``evaluate`` found, for a person."""
    lines = []
    if errors["segments"]:
        first, last = errors["segments"][0]["length"], errors["segments"][-1]["length"]
        lines.append(
            f"segments of {first:.3g} to {last:.3g}: {errors['translation_percent']:.3f} %, "
            f"{errors['deg_per_100']:.3f} deg/100"
        )
    lines.append(
        f"ATE {errors['ate_rmse']:.4g}, RPE {errors['rpe_translation_rmse']:.4g} and "
        f"{errors['rpe_rotation_deg_rmse']:.4g} deg a frame, end drift {errors['end_drift_percent']:.3f} %"
    )
    return lines


def plot(path: Path, poses: np.ndarray, truth: np.ndarray) -> None:
    """Both paths from above (the two axes along which the truth extends most), as .png, .pdf or .svg."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    paths = [(np.linalg.inv(p[0]) @ p)[:, :3, 3] for p in (truth, poses)]
    a, b = sorted(np.argsort(np.ptp(paths[0], axis=0))[-2:])
    figure = Figure(figsize=(6, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for positions, style, label in zip(paths, ("k--", "C0-"), ("truth", "fmr"), strict=True):
        axes.plot(positions[:, a], positions[:, b], style, label=label)
    axes.set(aspect="equal", xlabel="xyz"[a], ylabel="xyz"[b])
    axes.legend()
    with atomic_write(path) as part:
        figure.savefig(part)
