"""Coordinates in which a cloud is worked on, by name, and what a pose is in them.

The same cloud is seen in several frames: the file's coordinates; centred ones (about the cloud's mean, so that nothing
is lost far from the origin); in voxel edges (so that thresholds have no unit); in the encoder's unit box. Each is a
shift and a change of unit, and a rigid pose stays rigid as long as both clouds share the unit.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Frame:
    """x_frame = (x - origin) / unit. origin: (3,) in the coordinates that the frame is defined in; unit: a length."""

    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    unit: float = 1.0

    def enter(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the outer coordinates in this frame."""
        local = points - self.origin
        return local if self.unit == 1.0 else local / self.unit

    def leave(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of this frame in the outer coordinates."""
        return points * self.unit + self.origin


def enter_frames(T_target_source: np.ndarray, source: Frame, target: Frame) -> np.ndarray:
    """A pose (4, 4) between outer coordinates as one between two frames of one unit."""
    T, R = T_target_source.copy(), T_target_source[:3, :3]
    T[:3, 3] = (T[:3, 3] + R @ source.origin - target.origin) / target.unit
    return T


def leave_frames(T_target_source: np.ndarray, source: Frame, target: Frame) -> np.ndarray:
    """A pose (4, 4) between two frames of one unit as one between outer coordinates; undoes ``enter_frames``."""
    T, R = T_target_source.copy(), T_target_source[:3, :3]
    T[:3, 3] = target.unit * T[:3, 3] + target.origin - R @ source.origin
    return T
