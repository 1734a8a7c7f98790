"""How far one pose lies from another: the angle of the rotation between them, and the shift of a point."""

from __future__ import annotations

import numpy as np

from fmr_cli.cloud import rotation_angle, transform_points


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The angle in radians between rotations (..., 3, 3), batch dimensions broadcast: (...)."""
    return rotation_angle(np.swapaxes(a, -1, -2) @ b)


def pose_error(
    T_found: np.ndarray, T_true: np.ndarray, centre: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Of rigid poses (..., 4, 4) of one source: the angle in degrees, and the shift of the centre in the points' unit.

    centre: (3,) in the source's frame, its origin by default; the shift is how far the two poses put it apart, and
    unlike the difference of the translations does not depend on where the origin lies.
    """
    degrees = np.degrees(angle_between(T_true[..., :3, :3], T_found[..., :3, :3]))
    point = np.asarray(centre)[None]
    shift = transform_points(T_found, point) - transform_points(T_true, point)
    return degrees, np.linalg.norm(shift[..., 0, :], axis=-1)
