"""The odometry's own coordinates, and the way there and back: the only place that knows both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class VoxelFrame:
    """Coordinates that are counted in voxels from ``origin``: x_voxels = (x_file - origin) / voxel.

    voxel: the working edge, file units. origin: (3,) near the first scan's middle, file units. A scan and the map are
    both expressed so; in file units a pose is T_first_scan (a scan's own frame to the first scan's), in voxels
    T_map_scan, which is the identity for the first scan as well.
    """

    voxel: float
    origin: np.ndarray

    @property
    def sensor(self) -> np.ndarray:
        """(3,), voxels: where a scan's sensor is, the origin of its file's coordinates."""
        return -self.origin / self.voxel

    def points_to_voxels(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of a scan, file units to voxels."""
        return (points - self.origin) / self.voxel

    def pose_to_file(self, T_map_scan: np.ndarray) -> np.ndarray:
        """T_first_scan (4, 4), file units, of T_map_scan (4, 4), voxels."""
        T_first_scan = T_map_scan.copy()
        T_first_scan[:3, 3] = self.voxel * T_map_scan[:3, 3] + self.origin - T_map_scan[:3, :3] @ self.origin
        return T_first_scan

    def pose_to_voxels(self, T_first_scan: np.ndarray) -> np.ndarray:
        """The inverse of ``pose_to_file``."""
        T_map_scan = T_first_scan.copy()
        T_map_scan[:3, 3] = (T_first_scan[:3, 3] + T_first_scan[:3, :3] @ self.origin - self.origin) / self.voxel
        return T_map_scan
