"""A scanner that moves while it scans sees each point from another place: undo that, where points have times."""

from __future__ import annotations

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError

TIME_FIELDS = ("gps_time", "time", "timestamp", "t", "offset_time", "time_offset")


def time_field(cloud: PointCloud) -> str | None:
    """The name of the field that holds the points' times, or None."""
    return next((n for n in TIME_FIELDS if n in cloud.attributes and cloud.attributes[n].ndim == 1), None)


def time_span(cloud: PointCloud) -> tuple[float, float] | None:
    """When a scan's first and last point were measured, in the file's own unit (int or float); None if unknown."""
    name = time_field(cloud)
    values = cloud.attributes[name] if name else np.zeros(0)
    values = values[np.isfinite(values)]
    return (values.min().item(), values.max().item()) if len(values) else None


def scan_times(cloud: PointCloud) -> np.ndarray:
    """(N,) when each point was measured: 0 for the scan's first, 1 for its last, whatever unit the file has.

    A point whose time is not finite gets the middle. Raises CloudFileError where no field tells times apart.
    """
    name = time_field(cloud)
    if name is None:
        known = ", ".join(TIME_FIELDS)
        raise CloudFileError(f"{cloud.name}: has no time per point (fields {known}), use --no-deskew")
    values = cloud.attributes[name]
    finite = np.isfinite(values)
    # Subtracted in the file's type: nanoseconds since 1970 have more digits than float64.
    since = (values - values[finite].min()).astype(np.float64) if finite.any() else np.zeros(len(values))
    last = since[finite].max(initial=0.0)
    if not last > 0:
        raise CloudFileError(f"{cloud.name}: field {name} is the same for all points, use --no-deskew")
    return np.where(finite, since / last, 0.5)


def deskew(points: np.ndarray, times: np.ndarray, T_begin_end: np.ndarray) -> np.ndarray:
    """Points as the scanner would have seen them had it stood where it was in the middle of the scan.

    points: (N, 3), file units, each in the sensor's frame of its own moment; times: (N,), 0 to 1 over the scan;
    T_begin_end: (4, 4), the sensor's frame at 1 to that at 0. Returns (N, 3), file units, in the frame at 0.5.
    With the motion's constant turn w and velocity v, and u = time - 0.5: x -> exp(u w) x + u v + u^2 / 2 w x v, where
    v + w x v / 2 is the motion's shift (the arc to second order). The middle is also what the pose of an untouched
    scan refers to on average.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(T_begin_end[:3, :3]).as_rotvec()
    velocity = np.linalg.solve(np.eye(3) + np.cross(turn, np.eye(3)).T / 2, T_begin_end[:3, 3])
    u = (times - 0.5)[:, None]
    shift = u * velocity + u**2 / 2 * np.cross(turn, velocity)
    return Rotation.from_rotvec(u * turn).apply(points) + shift
