"""A scan that was measured on the move, and can be made ready again once the motion within it is better known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.se3 import exp, log
from fmr_cli.sequence.deskew import deskew
from fmr_cli.sequence.prepared_scan import PreparedScan, prepare_scan
from fmr_cli.sequence.voxel_frame import VoxelFrame


@dataclass(frozen=True)
class MovingScan:
    """A scan as it was measured, and what is known of the motion within it.

    cloud: file units, each point in the sensor's frame of its own moment. times: (N,), 0 to 1 over the scan.
    T_begin_end: (4, 4), file units, the sensor's frame at 1 to that at 0. share: how long the scan lasts over the time
    since the one before it.
    """

    cloud: PointCloud
    times: np.ndarray
    T_begin_end: np.ndarray
    share: float
    frame: VoxelFrame

    def still(self) -> PointCloud:
        """The cloud as the scanner would have seen it had it stood where it was in the middle of the scan."""
        return replace(self.cloud, points=deskew(self.cloud.points, self.times, self.T_begin_end))

    def prepared(self) -> PreparedScan | None:
        """The same made ready; None where too few points are left."""
        return prepare_scan(self.still().points, self.frame, self.times)

    @property
    def twist(self) -> np.ndarray:
        """(6,): the motion within the scan, voxels, scan axes."""
        return self.frame.twist_to_voxels(log(self.T_begin_end))

    def with_twist(self, twist: np.ndarray) -> MovingScan:
        """The same scan with another motion (6,) within it, voxels, scan axes."""
        return replace(self, T_begin_end=exp(self.frame.twist_to_file(twist)))
