"""The odometry's own coordinates, and the way there and back: the only place that knows both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class VoxelFrame:
    """Coordinates that are counted in voxels from ``origin``: x_voxels = (x_file - origin) / voxel.

    voxel: the working edge, file units. origin: (3,) near the first scan's middle, file units; map_origin: the same for
    the map, near its middle where it is a known one. In file units a pose is T_first_scan (a scan's own frame to the
    first scan's, or to the known map's), in voxels T_map_scan.
    """

    voxel: float
    origin: np.ndarray
    map_origin: np.ndarray | None = None

    @property
    def of_map(self) -> np.ndarray:
        """(3,), file units: where the map's coordinates in voxels begin."""
        return self.origin if self.map_origin is None else self.map_origin

    def to_json(self) -> dict[str, Any]:
        return {"voxel": self.voxel, "origin": self.origin.tolist(), "map_origin": self.of_map.tolist()}

    @classmethod
    def from_json(cls, said: dict[str, Any]) -> VoxelFrame:
        return cls(said["voxel"], np.array(said["origin"]), np.array(said["map_origin"]))

    @property
    def sensor(self) -> np.ndarray:
        """(3,), voxels: where a scan's sensor is, the origin of its file's coordinates."""
        return -self.origin / self.voxel

    def points_to_voxels(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of a scan, file units to voxels."""
        moved = points - self.origin
        moved /= self.voxel
        return moved

    def pose_to_file(self, T_map_scan: np.ndarray) -> np.ndarray:
        """T_first_scan (4, 4), file units, of T_map_scan (4, 4), voxels."""
        T_first_scan = T_map_scan.copy()
        T_first_scan[:3, 3] = self.voxel * T_map_scan[:3, 3] + self.of_map - T_map_scan[:3, :3] @ self.origin
        return T_first_scan

    def twist_to_file(self, twist: np.ndarray) -> np.ndarray:
        """A motion (6,) in a scan's axes, voxels to file units."""
        return np.concatenate([twist[:3], self.voxel * twist[3:] - np.cross(twist[:3], self.origin)])

    def twist_to_voxels(self, twist: np.ndarray) -> np.ndarray:
        """The inverse of ``twist_to_file``."""
        return np.concatenate([twist[:3], (twist[3:] + np.cross(twist[:3], self.origin)) / self.voxel])

    def pose_to_voxels(self, T_first_scan: np.ndarray) -> np.ndarray:
        """The inverse of ``pose_to_file``."""
        T_map_scan = T_first_scan.copy()
        T_map_scan[:3, 3] = (T_first_scan[:3, 3] + T_first_scan[:3, :3] @ self.origin - self.of_map) / self.voxel
        return T_map_scan
