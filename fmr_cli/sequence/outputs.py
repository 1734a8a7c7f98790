"""All that a run leaves behind while it goes on and at its end, kept in step: what is in one file is in all of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.io import write_cloud
from fmr_cli.sequence.growing_map import GrowingMap
from fmr_cli.sequence.journal import Beginning, Journal
from fmr_cli.sequence.loader import Loader
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.result import SequenceResult, odometry_path
from fmr_cli.sequence.scans import Scans
from fmr_cli.sequence.writers import PoseFile, ResidualTable


class Outputs:
    """The journal, the poses, the table of residuals and the map of one run. A context: it closes the files.

    Poses come in as T_first_scan, and are written as the options ask. The map grows with the frames; with loop closure
    it is made at the end, along the closed path.
    """

    def __init__(
        self, scans: Scans, options: SequenceOptions, journal: Journal, *, out: Path | None, residuals: Path | None,
        merged: Path | None, voxel: float,
    ) -> None:  # fmt: skip
        self.journal, self.out, self.merged = journal, out, merged
        self.poses, self.table = PoseFile(out, options.format, scans.times), ResidualTable(residuals)
        self.map = GrowingMap(options.merged_voxel or voxel / 2) if merged else None
        self.map_at_end = options.loop_closure
        self.T_camera_scan = scans.T_camera_scan if options.camera_frame else None

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, *_: object) -> None:
        for file in (self.journal, self.poses, self.table):
            file.close()

    def begin(
        self, beginning: Beginning, done: list[dict[str, Any]], rows: list[dict[str, Any]], poses: list[np.ndarray],
        loader: Loader,
    ) -> None:  # fmt: skip
        """Make the files, with what an earlier run has done; done: its lines of the journal."""
        self.journal.begin(beginning, done)
        self.poses.begin(self.written(pose) for pose in poses)
        self.table.begin(rows)
        if not self.map_at_end:
            self.add_to_map(rows, poses, loader)

    def add(
        self, row: dict[str, Any], T_first_scan: np.ndarray, cloud: PointCloud | None, record: dict[str, Any]
    ) -> None:
        """A frame. cloud: None where it is not kept for the map; record: what the journal has besides the row."""
        if self.map and cloud is not None and row["status"] == "aligned" and not self.map_at_end:
            self.map.add(cloud, T_first_scan, row["frame"])
        self.journal.add({"row": row, **record})
        self.poses.add(row["frame"], self.written(T_first_scan))
        self.table.add(row)

    def finish(self, result: SequenceResult, T_first_scan: np.ndarray, loader: Loader) -> None:
        """What can only be written at the end; T_first_scan (n, 4, 4): the final path."""
        if result.odometry_poses is not None and self.out:
            self.poses.write_all(odometry_path(self.out), result.odometry_poses, result.rows)
        if result.odometry_poses is not None or self.poses.format == "json":
            self.poses.write_all(self.out, result.poses, result.rows)
        if self.map_at_end:
            self.add_to_map(result.rows, T_first_scan, loader)
        if self.map and self.merged:
            write_cloud(self.merged, self.map.cloud())
        self.journal.remove()

    def add_to_map(self, rows: list[dict[str, Any]], T_first_scan: Iterable[np.ndarray], loader: Loader) -> None:
        """The aligned ones of these frames, read again."""
        if self.map:
            for row, pose in zip(rows, T_first_scan, strict=True):
                if row["status"] == "aligned":
                    self.map.add(loader.cloud(row["frame"]), pose, row["frame"])

    def written(self, T_first_scan: np.ndarray) -> np.ndarray:
        """A pose, or poses (n, 4, 4), in the frame that they are written in: the scanner's, or the camera's."""
        T = self.T_camera_scan
        return T_first_scan if T is None else T @ T_first_scan @ np.linalg.inv(T)
