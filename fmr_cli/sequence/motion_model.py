"""Where the next frame is before its scan is looked at, and how sure that is: constant velocity, and what is told.

A Kalman filter for the errors of the last pose and of the motion to it, both as twists (omega, v) on the right, in the
scan's own axes; its state is that pose and that motion, its measurements the motions that are told from elsewhere
(``Told``) and what the scans have observed. So in a tunnel the position along it grows uncertain at the pace of the
speed's own uncertainty. Lengths are in voxels.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.geometry.point_to_plane import step_motion
from fmr_cli.geometry.se3 import adjoint, exp, log
from fmr_cli.sequence.local_map import WIDE, orthonormal
from fmr_cli.sequence.observability import Observability

ERRORS_KEPT = 15  # predictions that say how much a motion changes from frame to frame
# The first motion of all is within reach of the zero-motion prior, or it is not found at all: so much for its sigma.
FIRST_MOTION = WIDE
FIRST_CHANGE = 1.0  # voxels, sigma of a motion's change before any has been seen, and worth one that has
LEAST_CHANGE = 0.02  # voxels: no scanner is carried more evenly
SURE = 0.5  # voxels, sigma of a pose, up to which the way from it to the next one is the motion
LONGEST_GAP = 10.0  # times the time between the scans before: beyond, nobody knows how a motion has gone on


@dataclass(frozen=True)
class Told:
    """A motion known from elsewhere, T_last_next (4, 4), with its sigmas (radians, voxels) at the sensor.

    sensor: (3,), voxels, where it is in a scan's axes.
    """

    T_last_next: np.ndarray
    rotation: float
    shift: float
    sensor: np.ndarray


@dataclass(frozen=True)
class Expected:
    """The next frame before its scan is looked at: its pose T_map_scan, the motion to it T_last_next, (4, 4) each.

    covariance: (12, 12), of (pose, motion). told: what was told of the motion.
    """

    T_map_scan: np.ndarray
    T_last_next: np.ndarray
    covariance: np.ndarray
    told: Told | None = None


class MotionModel:
    """The last pose T_map_scan, the motion to it T_last_next, and the covariance (12, 12) of (pose, motion).

    radius: what turns radians into displacement, of the first scan's points about its sensor. begun: whether there has
    been a motion; sure: whether the last pose is within SURE.
    """

    def __init__(self, T_map_scan: np.ndarray, radius: float) -> None:
        self.T_map_scan, self.T_last_next, self.begun = T_map_scan, np.eye(4), False
        self.sure = True
        self.radius = radius
        self.changes: deque[tuple[float, float]] = deque(maxlen=ERRORS_KEPT)  # squared: radians², voxels², per axis
        self.told_errors: deque[tuple[float, float]] = deque(maxlen=ERRORS_KEPT)  # likewise, of what was told
        self.covariance = np.zeros((12, 12))
        self.covariance[6:, 6:] = diagonal((FIRST_MOTION / radius) ** 2, FIRST_MOTION**2)

    def expect(self, told: Told | None = None, pace: float = 1.0) -> Expected:
        """The next frame, ``pace`` times as long after the last one as that after the one before it."""
        if not 0 < pace <= LONGEST_GAP:
            pace = 1.0 if pace <= 0 or np.isnan(pace) else LONGEST_GAP
        motion = self.T_last_next if pace == 1.0 else exp(pace * log(self.T_last_next))
        carry = np.zeros((12, 12))
        carry[:6, :6] = adjoint(np.linalg.inv(motion))
        carry[:6, 6:] = carry[6:, 6:] = pace * np.eye(6)
        both = np.vstack([np.eye(6), np.eye(6)])
        covariance = carry @ self.covariance @ carry.T + pace**2 * (both @ self._change() @ both.T)
        correction = np.zeros(12)
        if told is not None:
            about = adjoint(moved_by(told.sensor))
            noise = about @ self._usual(self.told_errors, told.rotation, told.shift) @ about.T
            gain = np.linalg.solve(covariance[6:, 6:] + noise, covariance[6:]).T
            correction = gain @ log(np.linalg.inv(motion) @ told.T_last_next)
            covariance = covariance - gain @ covariance[6:]
        pose = self.T_map_scan @ motion @ exp(correction[:6])
        moved = self.begun or told is not None
        return Expected(
            orthonormal(pose) if moved else self.T_map_scan, orthonormal(motion @ exp(correction[6:])),
            (covariance + covariance.T) / 2, told,
        )  # fmt: skip

    def combined(self, T_map_scan: np.ndarray, expected: Expected, seen: Observability) -> np.ndarray:
        """The pose of a scan that was fitted to T_map_scan, given what was expected and what is observed.

        Along what is observed it is the fit, along the rest the prediction, each as sure as it is.
        """
        motion = T_map_scan @ np.linalg.inv(expected.T_map_scan)
        pivot = transform_points(np.linalg.inv(motion), seen.centre[None])[0]
        twist = np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), seen.centre - pivot])
        about = about_centre(expected.T_map_scan, pivot)
        covariance = about @ expected.covariance[:6, :6] @ about.T
        root = square_root(seen.information)
        gain = covariance @ root
        twist = gain @ np.linalg.solve(np.eye(root.shape[1]) + root.T @ gain, root.T @ twist)
        return step_motion(twist, pivot) @ expected.T_map_scan

    def advance(self, T_map_scan: np.ndarray, expected: Expected, seen: Observability | None) -> None:
        """Go on to the next frame's pose; seen: what its scan observed of it, None where it is the prediction."""
        error = log(np.linalg.inv(expected.T_map_scan) @ T_map_scan)
        of_pose = expected.covariance[:6, :6]
        self.T_last_next = expected.T_last_next @ exp(
            expected.covariance[6:, :6] @ np.linalg.lstsq(of_pose, error, rcond=1e-12)[0]
        )
        observed = seen is not None and bool(seen.observed.all())
        if observed and self.sure:  # else the way from the last pose to here makes up for what that one was off
            moved = np.linalg.inv(self.T_map_scan) @ T_map_scan
            self.T_last_next = moved
            if self.begun:
                self.changes.append(squares(error))
            if expected.told is not None:
                there = moved_by(expected.told.sensor)  # the sensor's own motion
                apart = np.linalg.inv(there) @ np.linalg.inv(expected.told.T_last_next) @ moved @ there
                self.told_errors.append(squares(log(apart)))
        self.T_map_scan, self.covariance = T_map_scan, expected.covariance
        self.begun = True
        if seen is not None:
            self._learn(T_map_scan, seen)
        rotation, shift = self.sigma(T_map_scan[:3, 3])
        self.sure = max(rotation * self.radius, shift) < SURE

    def _learn(self, T_map_scan: np.ndarray, seen: Observability) -> None:
        """Take what the scan at the last pose has observed into the covariance."""
        about = about_centre(T_map_scan, seen.centre)
        root = square_root(about.T @ seen.information @ about)
        gain = self.covariance[:, :6] @ root
        gain = np.linalg.solve(np.eye(root.shape[1]) + root.T @ gain[:6], gain.T).T
        self.covariance = self.covariance - gain @ (root.T @ self.covariance[:6])
        self.covariance = (self.covariance + self.covariance.T) / 2

    def forget_place(self, T_map_scan: np.ndarray) -> None:
        """The map begins anew here: what is uncertain about the place is no more than in the map's own frame."""
        self.T_map_scan = T_map_scan
        self.covariance[:6] = self.covariance[:, :6] = 0.0

    def sigma(self, centre: np.ndarray) -> tuple[float, float]:
        """The last pose's standard deviations, each along its worst direction: rotation (rad), and shift (voxels).

        The shift is that of a point at ``centre`` (3,), map axes.
        """
        about = about_centre(self.T_map_scan, centre)
        C = about @ self.covariance[:6, :6] @ about.T
        rotation, shift = (np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0)) for block in (C[:3, :3], C[3:, 3:]))
        return float(rotation), float(shift)

    def information_within(self, share: float) -> np.ndarray:
        """(6, 6), rad⁻² and voxels⁻²: how surely the motion within a scan is that from frame to frame.

        share: how long the scan lasts over the time between frames.
        """
        return np.linalg.inv(share**2 * self._change())

    def _change(self) -> np.ndarray:
        """(6, 6), of a motion's change from one frame to the next."""
        return self._usual(self.changes, FIRST_CHANGE / self.radius, FIRST_CHANGE)

    def _usual(self, errors: deque[tuple[float, float]], rotation: float, shift: float) -> np.ndarray:
        """(6, 6), of errors like those seen so far, to which the sigmas given beforehand (rad, voxels) count as one."""
        r2, s2 = np.mean([(rotation**2, shift**2), *errors], axis=0)
        return diagonal(max(r2, (LEAST_CHANGE / self.radius) ** 2), max(s2, LEAST_CHANGE**2))

    def state(self) -> dict[str, Any]:
        """What ``restored`` needs; JSON types."""
        return {
            "T_map_scan": self.T_map_scan.tolist(), "T_last_next": self.T_last_next.tolist(), "begun": self.begun,
            "sure": self.sure,
            "covariance": self.covariance.tolist(), "changes": list(self.changes),
            "told_errors": list(self.told_errors), "radius": self.radius,
        }  # fmt: skip

    @classmethod
    def restored(cls, state: dict[str, Any]) -> MotionModel:
        model = cls(np.array(state["T_map_scan"]), state["radius"])
        model.T_last_next, model.begun = np.array(state["T_last_next"]), state["begun"]
        model.sure = state["sure"]
        model.covariance = np.array(state["covariance"])
        for errors, kept in ((model.changes, state["changes"]), (model.told_errors, state["told_errors"])):
            errors.extend((rotation, shift) for rotation, shift in kept)
        return model


def told_motion(T_last_next: np.ndarray, rotation: float | None, shift: float | None, sensor: np.ndarray) -> Told:
    """A motion with sigmas (radians, voxels), or with rough ones: a tenth of it and a little, as odometers have it."""
    if rotation is None:
        rotation = 0.1 * float(np.radians(angle_degrees(T_last_next))) + 0.01
    if shift is None:
        shift = 0.1 * float(np.linalg.norm(T_last_next[:3, 3])) + LEAST_CHANGE
    return Told(T_last_next, rotation, shift, sensor)


def squares(twist: np.ndarray) -> tuple[float, float]:
    """The mean squares of a twist's two parts, per axis."""
    return float(twist[:3] @ twist[:3]) / 3, float(twist[3:] @ twist[3:]) / 3


def diagonal(rotation: float, shift: float) -> np.ndarray:
    return np.diag([rotation] * 3 + [shift] * 3)


def moved_by(shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = shift
    return T


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
