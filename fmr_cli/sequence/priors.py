"""What is known of the poses beforehand, as by wheel odometry or GNSS: the motion from one frame to the next."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fmr_cli.io.folders import stem
from fmr_cli.multiway.known import KnownPose, finder, number_of
from fmr_cli.multiway.scans import Scan
from fmr_cli.sequence.motion_model import Told, told_motion
from fmr_cli.sequence.scans import Scans
from fmr_cli.sequence.voxel_frame import VoxelFrame


class Priors:
    """Poses of some of the frames, T_world_scan, file units, in any world of their own."""

    def __init__(self, scans: Scans, poses: Mapping[str, KnownPose], frame: VoxelFrame) -> None:
        """poses: by a scan's name, file name or path. Raises FmrError for a name that no scan has."""
        self.frame = frame
        self.by_frame = by_frame(scans, poses)

    def first(self) -> np.ndarray | None:
        """T_map_scan (4, 4) of the first frame, voxels, where the world is a known map."""
        first = self.by_frame.get(0)
        return self.frame.pose_to_voxels(first.T_world_scan) if first else None

    def motion(self, index: int) -> Told | None:
        """The motion to a frame from the one before it, where both are known, with both their sigmas."""
        before, here = self.by_frame.get(index - 1), self.by_frame.get(index)
        if before is None or here is None:
            return None
        poses = [self.frame.pose_to_voxels(known.T_world_scan) for known in (before, here)]
        turn = both(before.sigma_rot_deg, here.sigma_rot_deg)
        shift = both(before.sigma_shift, here.sigma_shift)
        return told_motion(
            np.linalg.inv(poses[0]) @ poses[1],
            None if turn is None else float(np.radians(turn)),
            None if shift is None else shift / self.frame.voxel,
            self.frame.sensor,
        )


def by_frame(scans: Scans, poses: Mapping[str, KnownPose]) -> dict[int, KnownPose]:
    """The poses by the frames' numbers; those of scans that were left out by --start, --stop or --step are left out."""
    if not poses:
        return {}
    named = [Scan(stem(source) if isinstance(source, Path) else f"cloud_{number:03d}", source)
             for number, source in enumerate(scans.all_sources)]  # fmt: skip
    known = finder(named)
    place = {number: index for index, number in enumerate(scans.chosen)}
    found = {}
    for name, pose in poses.items():
        number = known[name] if name in known else number_of(name, named, "--init-poses")
        if number in place:
            found[place[number]] = pose
    return found


def both(a: float | None, b: float | None) -> float | None:
    """The sigma of a difference."""
    return None if a is None or b is None else float(np.hypot(a, b))
