"""Constant velocity: where the next frame is before its scan is looked at, and how sure that is.

A Kalman filter for the errors of the last pose and of the last motion, both as twists (omega, v) in the scan's own
axes; its state is the poses themselves, its measurement what the scan has observed. So in a tunnel the position along
it grows uncertain at the pace of the speed's own uncertainty. Lengths are in voxels.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.point_to_plane import step_motion
from fmr_cli.sequence.local_map import WIDE, orthonormal
from fmr_cli.sequence.observability import Observability

ERRORS_KEPT = 15  # predictions that say how much a motion changes from frame to frame
# The first motion of all is within reach of the zero-motion prior, or it is not found at all: so much for its sigma.
FIRST_MOTION = WIDE
FIRST_CHANGE = 1.0  # voxels, sigma of a motion's change before any has been seen, and worth one that has
LEAST_CHANGE = 0.02  # voxels: no scanner is carried more evenly


class MotionModel:
    """The last two poses, T_map_scan each, and the covariance (12, 12) of (pose, motion).

    radius: what turns radians into displacement, of the first scan's points about its sensor.
    """

    def __init__(self, T_map_scan: np.ndarray, radius: float) -> None:
        self.T_map_last = [T_map_scan]
        self.radius = radius
        self.changes: deque[tuple[float, float]] = deque(maxlen=ERRORS_KEPT)  # squared: radians², voxels², per axis
        self.covariance = np.zeros((12, 12))
        self.covariance[6:, 6:] = self._diagonal((FIRST_MOTION / radius) ** 2, FIRST_MOTION**2)

    @staticmethod
    def _diagonal(rotation: float, shift: float) -> np.ndarray:
        return np.diag([rotation] * 3 + [shift] * 3)

    def motion(self) -> np.ndarray:
        """T_last_next (4, 4), as the last motion was; none before there was one."""
        before, last = self.T_map_last[0], self.T_map_last[-1]
        return np.linalg.inv(before) @ last if len(self.T_map_last) > 1 else np.eye(4)

    def predict(self) -> np.ndarray:
        """T_map_scan of the next frame."""
        last = self.T_map_last[-1]
        return orthonormal(last @ self.motion()) if len(self.T_map_last) > 1 else last

    def combined(self, T_map_scan: np.ndarray, T_map_predicted: np.ndarray, seen: Observability) -> np.ndarray:
        """The pose of a scan that was fitted to T_map_scan, given the prediction and what is observed.

        Along what is observed it is the fit, along the rest the prediction, each as sure as it is.
        """
        motion = T_map_scan @ np.linalg.inv(T_map_predicted)
        pivot = transform_points(np.linalg.inv(motion), seen.centre[None])[0]
        twist = np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), seen.centre - pivot])
        about = about_centre(T_map_predicted, pivot)
        covariance = about @ self._predicted()[:6, :6] @ about.T
        root = square_root(seen.information)
        gain = covariance @ root
        twist = gain @ np.linalg.solve(np.eye(root.shape[1]) + root.T @ gain, root.T @ twist)
        return step_motion(twist, pivot) @ T_map_predicted

    def advance(self, T_map_scan: np.ndarray, T_map_predicted: np.ndarray, seen: Observability | None) -> None:
        """Go on to the next frame's pose; seen: what its scan observed of it, None where it is the prediction."""
        self.covariance = self._predicted()
        self.T_map_last = [self.T_map_last[-1], T_map_scan]
        if seen is None:
            return
        about = about_centre(T_map_scan, seen.centre)
        root = square_root(about.T @ seen.information @ about)
        gain = self.covariance[:, :6] @ root
        gain = np.linalg.solve(np.eye(root.shape[1]) + root.T @ gain[:6], gain.T).T
        self.covariance = self.covariance - gain @ (root.T @ self.covariance[:6])
        self.covariance = (self.covariance + self.covariance.T) / 2
        if seen.observed.all():
            error = np.linalg.inv(T_map_predicted) @ T_map_scan
            turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
            self.changes.append((float(turn @ turn) / 3, float(error[:3, 3] @ error[:3, 3]) / 3))

    def _predicted(self) -> np.ndarray:
        """The covariance of the next frame's pose and motion, before its scan is looked at."""
        carry = np.eye(12)
        carry[:6, :6] = adjoint(np.linalg.inv(self.motion()))
        carry[:6, 6:] = np.eye(6)
        both = np.vstack([np.eye(6), np.eye(6)])
        return carry @ self.covariance @ carry.T + both @ self._change() @ both.T

    def forget_place(self) -> None:
        """The map begins anew here: what is uncertain about the place is no more than in the map's own frame."""
        self.covariance[:6] = self.covariance[:, :6] = 0.0

    def sigma(self, centre: np.ndarray) -> tuple[float, float]:
        """The last pose's standard deviations, each along its worst direction: rotation (rad), and shift (voxels).

        The shift is that of a point at ``centre`` (3,), map axes.
        """
        about = about_centre(self.T_map_last[-1], centre)
        C = about @ self.covariance[:6, :6] @ about.T
        rotation, shift = (np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0)) for block in (C[:3, :3], C[3:, 3:]))
        return float(rotation), float(shift)

    def _change(self) -> np.ndarray:
        """(6, 6), of a motion's change from one frame to the next."""
        first = ((FIRST_CHANGE / self.radius) ** 2, FIRST_CHANGE**2)
        rotation, shift = np.mean([first, *self.changes], axis=0)
        return self._diagonal(max(rotation, (LEAST_CHANGE / self.radius) ** 2), max(shift, LEAST_CHANGE**2))

    def state(self) -> dict[str, Any]:
        """What ``restore`` needs besides the poses; JSON types."""
        return {"covariance": self.covariance.tolist(), "changes": list(self.changes), "radius": self.radius}

    @classmethod
    def restored(cls, state: dict[str, Any], T_map_last: list[np.ndarray]) -> MotionModel:
        model = cls(T_map_last[-1], state["radius"])
        model.T_map_last, model.covariance = T_map_last, np.array(state["covariance"])
        model.changes.extend((rotation, shift) for rotation, shift in state["changes"])
        return model


def adjoint(T_a_b: np.ndarray) -> np.ndarray:
    """(6, 6): a twist in the axes of b as one in the axes of a."""
    R = T_a_b[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = np.cross(T_a_b[:3, 3], R, axis=0)
    return out


def about_centre(T_map_scan: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(6, 6): a twist in the scan's axes, about its origin, as one in the map's, about ``centre`` (3,)."""
    out = adjoint(T_map_scan)
    out[3:, :3] += np.cross(out[:3, :3], centre, axis=0)
    return out


def square_root(A: np.ndarray) -> np.ndarray:
    """G (6, k) with A = G Gᵀ, of a symmetric A (6, 6) that may be singular."""
    values, vectors = np.linalg.eigh((A + A.T) / 2)
    kept = values > 1e-12 * max(values[-1], 1e-300)
    return vectors[:, kept] * np.sqrt(values[kept])
