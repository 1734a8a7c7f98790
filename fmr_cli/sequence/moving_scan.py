"""A scan that was measured on the move, and can be made ready again once the motion within it is better known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.se3 import exp, log
from fmr_cli.sequence.deskew import deskew
from fmr_cli.sequence.prepared_scan import PreparedScan, prepare_scan
from fmr_cli.sequence.voxel_frame import VoxelFrame


@dataclass(frozen=True)
class Within:
    """The motion within a scan.

    T_begin_end: (4, 4), file units, the sensor's frame at the scan's end to that at its beginning, as far as it was
    known when the scan was thinned. rest: (6,), voxels, scan axes, how much more it is.
    """

    T_begin_end: np.ndarray
    rest: np.ndarray = field(default_factory=lambda: np.zeros(6))

    def to_json(self) -> list[Any]:
        return [self.T_begin_end.tolist(), self.rest.tolist()]

    @classmethod
    def from_json(cls, said: list[Any]) -> Within:
        return cls(*map(np.array, said))


@dataclass(frozen=True)
class MovingScan:
    """A scan as it was measured, and what is known of the motion within it.

    cloud: file units, each point in the sensor's frame of its own moment. times: (N,), 0 to 1 over the scan.
    within: the motion in the scan. share: how long the scan lasts over the time since the one before it.
    """

    cloud: PointCloud
    times: np.ndarray
    within: Within
    share: float
    frame: VoxelFrame

    def still(self) -> PointCloud:
        """The cloud as the scanner would have seen it had it stood where it was in the middle of the scan."""
        T_begin_end = self.with_twist(self.within.rest).within.T_begin_end
        return replace(self.cloud, points=deskew(self.cloud.points, self.times, T_begin_end))

    def prepared(self) -> PreparedScan | None:
        """The same made ready; None where too few points are left."""
        points = deskew(self.cloud.points, self.times, self.within.T_begin_end)
        scan = prepare_scan(points, self.frame, self.times)
        return scan.deskewed(self.within.rest) if scan and self.within.rest.any() else scan

    def with_twist(self, twist: np.ndarray) -> MovingScan:
        """The same scan with more motion (6,) in it, voxels, scan axes."""
        known = self.frame.twist_to_voxels(log(self.within.T_begin_end))
        return replace(self, within=Within(exp(self.frame.twist_to_file(known + twist))))

    def with_rest(self, twist: np.ndarray) -> MovingScan:
        """The same, but so little that it need not be thinned anew."""
        return replace(self, within=replace(self.within, rest=twist))
