"""The files of a sequence: poses as KITTI, TUM or JSON, and the table of residuals; grown line by line, or at once."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

import numpy as np

import fmr_cli
from fmr_cli.io.files import atomic_write
from fmr_cli.io.outputs import cell, write_json
from fmr_cli.sequence.options import Format

COLUMNS = (
    "frame", "file", "status", "start", "points", "overlap", "inlier_rmse", "feature_error_before",
    "feature_error_after", "motion", "rotation_deg", "unobserved", "sigma_shift", "sigma_rotation_deg", "deskewed_by",
    "read_s", "prepare_s", "register_s", "message",
)  # fmt: skip


class PoseFile:
    """The file of poses.

    path: or None: nothing is written. times: (n,), seconds, or None: the frames' numbers stand for them in TUM.
    KITTI and TUM grow by a line a frame; JSON, which is one object, is written once, by ``write_all``.
    """

    def __init__(self, path: Path | None, format: Format, times: np.ndarray | None) -> None:
        self.path, self.format, self.times = path, format, times
        self.file: TextIO | None = None

    def begin(self, poses: Iterable[np.ndarray]) -> None:
        """Write what an earlier run has done; opened for more."""
        if self.path and self.format != "json":
            self.file = begun(self.path, [self._line(index, pose) for index, pose in enumerate(poses)])

    def add(self, index: int, pose: np.ndarray) -> None:
        """A frame's pose (4, 4), on disk at once."""
        if self.file:
            self.file.write(self._line(index, pose))
            self.file.flush()

    def write_all(self, path: Path | None, poses: np.ndarray, rows: list[dict[str, Any]]) -> None:
        """All poses (n, 4, 4) into one file at once."""
        if path is None:
            return
        if self.format != "json":
            with atomic_write(path) as part:
                part.write_text("".join(self._line(index, pose) for index, pose in enumerate(poses)), "utf-8")
            return
        frames = [row | {"pose": pose.tolist()} for row, pose in zip(rows, poses, strict=True)]
        if self.times is not None:
            frames = [frame | {"time": float(time)} for frame, time in zip(frames, self.times, strict=True)]
        write_json(path, {"version": fmr_cli.__version__, "frames": frames})

    def close(self) -> None:
        if self.file:
            self.file.close()

    def _line(self, index: int, pose: np.ndarray) -> str:
        if self.format == "kitti":
            return numbers(pose[:3].ravel())
        time = float(index) if self.times is None else self.times[index]
        return f"{time:.9f} " + numbers([*pose[:3, 3], *quaternion(pose[:3, :3])])


class ResidualTable:
    """A CSV row a frame. path: or None: nothing is written."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.file: TextIO | None = None

    def begin(self, rows: Iterable[dict[str, Any]]) -> None:
        """Write the head and what an earlier run has done; opened for more."""
        if self.path:
            self.file = begun(self.path, [",".join(COLUMNS) + "\n", *map(csv_line, rows)])

    def add(self, row: dict[str, Any]) -> None:
        if self.file:
            self.file.write(csv_line(row))
            self.file.flush()

    def close(self) -> None:
        if self.file:
            self.file.close()


def begun(path: Path, lines: Iterable[str]) -> TextIO:
    """A text file that holds these lines, open for more."""
    with atomic_write(path) as part:
        part.write_text("".join(lines), "utf-8")
    return path.open("a", encoding="utf-8", newline="")


def numbers(values: Iterable[float]) -> str:
    """A line of numbers that are read back bit for bit; without minus zero."""
    return " ".join(f"{value + 0.0:.17g}" for value in values) + "\n"


def csv_line(row: dict[str, Any]) -> str:
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerow([cell(row.get(name, "")) for name in COLUMNS])
    return text.getvalue()


def quaternion(R: np.ndarray) -> np.ndarray:
    """(x, y, z, w) of a rotation matrix, w >= 0."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat(canonical=True)
