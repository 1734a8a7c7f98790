"""How to register a sequence: every option, checked where it is made."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from fmr_cli.errors import FmrError
from fmr_cli.registration.options import Options

Format = Literal["kitti", "tum", "json"]
FORMATS = get_args(Format)


@dataclass(frozen=True)
class SequenceOptions:
    """How to register a sequence. Lengths are in the scans' own unit; None means: taken from the data.

    format: of the file of poses. camera_frame: poses of the camera that ``calib.txt`` tells of, as KITTI's own truth.
    voxel_size: a wish for the working voxel edge, which follows from the first scan's density, within a factor of 1.25.
    merged_voxel: the map's voxel edge, or None: half the working one.
    loop_closure: at the end, recognise places seen before and optimise the pose graph.
    deskew: undo the motion within each scan, by the times of its points, or by their azimuth; its pose is that of the
    middle of the scan. None: where the first scan's points have times, or the scans show how a scanner turned.
    model: what ``fmr train`` has learnt (.safetensors), for the pairs that are registered on the way; None: bundled.
    Raises FmrError for a format that is not known, and for a voxel edge that is no positive number.
    """

    format: Format = "kitti"
    camera_frame: bool = False
    voxel_size: float | None = None
    merged_voxel: float | None = None
    loop_closure: bool = False
    deskew: bool | None = None
    model: Path | None = None

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise FmrError(f"format {self.format!r}: is not known, use one of {', '.join(FORMATS)}")
        for name in ("voxel_size", "merged_voxel"):
            edge = getattr(self, name)
            if edge is not None and not (math.isfinite(edge) and edge > 0):
                raise FmrError(f"{name} {edge}: must be more than 0, or left out to follow from the scans")

    @property
    def pair(self) -> Options:
        """How two scans, or a scan and a map, are registered where the motion alone does not do."""
        return Options(model=self.model)
