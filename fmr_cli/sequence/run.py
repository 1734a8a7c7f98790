"""A folder of scans in; a trajectory, a table of residuals and a map out. Written frame by frame, resumable.

What is needed to go on after a kill is in a journal beside the poses: a header, then a line a frame. It is removed at
the end.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TextIO

import numpy as np

import fmr_cli
from fmr_cli.cloud import PointCloud, angle_degrees
from fmr_cli.errors import CloudFileError, FmrError, RegistrationError
from fmr_cli.io import read_cloud, write_cloud
from fmr_cli.io.files import atomic_write, check_readable, reason
from fmr_cli.io.outputs import write_json
from fmr_cli.sequence.deskew import deskew, scan_times
from fmr_cli.sequence.growing_map import GrowingMap
from fmr_cli.sequence.loop_closure import check_installed, close_loops
from fmr_cli.sequence.odometry import Frame, Odometry, Scan, choose_voxel
from fmr_cli.sequence.scans import Scans

Format = Literal["kitti", "tum", "json"]
AHEAD = 2  # scans that are read and thinned while one is registered
ODD_SIZE = 10.0  # a scan so many times larger or smaller than the usual is not of this sequence
COLUMNS = (
    "frame", "file", "status", "start", "points", "overlap", "inlier_rmse", "feature_error_before",
    "feature_error_after", "motion", "rotation_deg", "read_s", "prepare_s", "register_s", "message",
)  # fmt: skip


@dataclass
class Loaded:
    """A scan as it came from its file: thinned, or None with a message that says why it cannot be used.

    cloud: as read, where it is needed after that.
    """

    scan: Scan | None
    cloud: PointCloud | None
    size: float
    row: dict[str, Any]


class Sequence:
    """One run over the scans of a sequence.

    out: the poses. residuals: a CSV row a frame. merged: the map, of voxels of ``merged_voxel`` (half the working
    voxel where None). loop_closure: at the end, close the loops in ``out``, and keep the path as it was followed
    in ``odometry_out``. camera_frame: poses of the camera that ``calib.txt`` tells of. voxel_size: the working voxel,
    file units, or None: taken from the first scan. deskew: undo the motion within each scan, by the times of its
    points; its pose is then that of the middle of the scan.
    Raises FmrError where the options ask for what the sequence does not have.
    """

    def __init__(
        self, scans: Scans, out: Path, *, form: Format = "kitti", camera_frame: bool = False,
        residuals: Path | None = None, merged: Path | None = None, merged_voxel: float | None = None,
        voxel_size: float | None = None, loop_closure: bool = False, deskew: bool = False,
    ) -> None:  # fmt: skip
        if camera_frame and scans.T_camera_scan is None:
            raise FmrError(f"{scans.files[0].parent}: no calib.txt with a line Tr, leave out --camera-frame")
        self.scans, self.out, self.form, self.residuals = scans, out, form, residuals
        self.T_camera_scan = scans.T_camera_scan if camera_frame else None
        self.merged, self.merged_voxel, self.voxel_size = merged, merged_voxel, voxel_size
        self.odometry_out = out.with_name(f"{out.stem}.odometry{out.suffix}")
        self.loop_closure, self.deskew = loop_closure, deskew
        self.loops = 0
        if loop_closure:
            check_installed()
        self.journal = out.with_name(out.name + ".journal")
        self.rows: list[dict[str, Any]] = []
        self.poses: list[np.ndarray] = []  # this frame to the first, file units
        self.sizes: deque[float] = deque(maxlen=15)

    def open(self, resume: bool) -> int:
        """Make ready; returns how many frames an earlier run has done. Raises FmrError where its settings differ."""
        records = self._read_journal() if resume else []
        if records:
            header, *lines = records
            self.odometry = Odometry(header["voxel"], np.array(header["origin"]))
            self.start = np.array(header["start"])
            poses = [np.array(line["T"]) for line in lines]
            self.rows = [line["row"] for line in lines]
            self.poses = [self.odometry.to_file(T) for T in poses]
            self.sizes.extend(line["size"] for line in lines if line["size"])
            if lines:
                self.odometry.restore(lines[-1]["state"], poses, lambda index: self._scan_again(index))
        else:
            first = self._read_first()
            voxel = self.voxel_size or choose_voxel(first)
            self.odometry = Odometry(voxel, np.median(first, axis=0))
            self.start = self._first_motion() if self.deskew else np.eye(4)
            lines = []
        settings = self._settings() | {
            "voxel": self.odometry.voxel, "origin": self.odometry.origin.tolist(), "start": self.start.tolist(),
        }  # fmt: skip
        self.map = GrowingMap(self.merged_voxel or self.odometry.voxel / 2) if self.merged else None
        with atomic_write(self.journal) as part:
            part.write_text("".join(json.dumps(record) + "\n" for record in [settings, *lines]), "utf-8")
        for index, row in enumerate(self.rows):
            if self.map and row["status"] == "aligned" and not self.loop_closure:
                self.map.add(self._whole(index), self.poses[index], index)
        return len(self.rows)

    def run(self) -> Iterator[dict[str, Any]]:
        """Register what is left; yields a row a frame once it is in the files."""
        start = len(self.rows)
        with ThreadPoolExecutor(1) as reader, self.journal.open("a", encoding="utf-8") as journal:
            tables = self._open_tables()
            waiting: deque[Future[Loaded]] = deque()
            try:
                for index in range(start, len(self.scans.files)):
                    for ahead in range(index + len(waiting), min(index + AHEAD + 1, len(self.scans.files))):
                        waiting.append(reader.submit(self._load, ahead))
                    row = self._step(index, waiting.popleft().result(), journal)
                    for table, line in zip(tables, self._lines(index), strict=True):
                        table.write(line)
                        table.flush()
                    yield row
            finally:
                for future in waiting:
                    future.cancel()
                for table in tables:
                    table.close()
        self._finish()

    def _step(self, index: int, loaded: Loaded, journal: TextIO) -> dict[str, Any]:
        begin = time.perf_counter()
        row = loaded.row
        if self.deskew:
            self._thin(loaded, index)
            begin = time.perf_counter()
        scan = None if self._odd(loaded, row) else loaded.scan
        try:
            frame = self.odometry.register(scan)
        except RegistrationError as error:
            raise RegistrationError(f"{self.scans.files[index]}: {error}") from None
        self.poses.append(frame.pose)
        self.rows.append(row)
        row |= self._described(frame, begin)
        if self.map and frame.status == "aligned" and loaded.cloud is not None and not self.loop_closure:
            self.map.add(loaded.cloud, frame.pose, index)
        record = {
            "row": row, "size": loaded.size, "T": self.odometry.poses[-1].tolist(), "state": self.odometry.state(),
        }  # fmt: skip
        journal.write(json.dumps(record) + "\n")
        journal.flush()
        return row

    def _odd(self, loaded: Loaded, row: dict[str, Any]) -> bool:
        """Whether the scan is of quite another size than those before it, most often one in another unit."""
        usual = float(np.median(self.sizes)) if self.sizes else loaded.size
        ratio = loaded.size / usual if loaded.size and usual else 1.0
        odd = not 1 / ODD_SIZE < ratio < ODD_SIZE
        if odd:
            row["message"] = f"{ratio:.3g} times the size of the scans before it, is it in another unit?"
            loaded.size = 0.0
        elif loaded.size:
            self.sizes.append(loaded.size)
        return odd

    def _described(self, frame: Frame, begin: float) -> dict[str, Any]:
        before = self.poses[-2] if len(self.poses) > 1 else frame.pose
        motion = np.linalg.inv(before) @ frame.pose
        said: dict[str, Any] = {"status": frame.status, "start": frame.start, "overlap": round(frame.overlap, 4)}
        if math.isfinite(frame.inlier_rmse):
            said["inlier_rmse"] = float(f"{frame.inlier_rmse:.6g}")
        if frame.feature_errors:
            said["feature_error_before"], said["feature_error_after"] = (
                float(f"{e:.6g}") for e in frame.feature_errors
            )
        said["motion"] = float(f"{np.linalg.norm(motion[:3, 3]):.6g}")
        said["rotation_deg"] = float(f"{angle_degrees(motion):.6g}")
        said["register_s"] = round(time.perf_counter() - begin, 4)
        return said

    def _load(self, index: int) -> Loaded:
        """Read one scan, and thin it where no motion is to be undone; runs beside the registration of others."""
        path = self.scans.files[index]
        loaded = Loaded(None, None, 0.0, {"frame": index, "file": path.name, "points": 0})
        begin = time.perf_counter()
        try:
            loaded.cloud = read_cloud(path, attributes=bool(self.merged) or self.deskew)
        except CloudFileError as error:
            loaded.row["message"] = str(error)
            return loaded
        loaded.row |= {"points": len(loaded.cloud), "read_s": round(time.perf_counter() - begin, 4)}
        if not self.deskew:
            self._thin(loaded, index)
        return loaded

    def _thin(self, loaded: Loaded, index: int) -> None:
        """Make a scan that was read ready to register; with ``deskew`` the frames before it must be known."""
        if loaded.cloud is None:
            return
        begin = time.perf_counter()
        try:
            cloud = self._deskewed(loaded.cloud, index)
        except CloudFileError as error:
            loaded.cloud, loaded.row["message"] = None, str(error)
            return
        loaded.scan = self.odometry.prepare(cloud.points)
        if loaded.scan is None:
            loaded.row["message"] = f"{cloud.name}: only {len(cloud)} points, too few to register"
        else:
            loaded.size = float(np.abs(loaded.scan.points).mean())
        loaded.cloud = cloud if self.merged else None
        loaded.row["prepare_s"] = round(time.perf_counter() - begin, 4)

    def _deskewed(self, cloud: PointCloud, index: int) -> PointCloud:
        """With ``deskew``, a scan without the motion within: that between the two frames before it."""
        if not self.deskew:
            return cloud
        times = scan_times(cloud)
        motion = np.linalg.inv(self.poses[index - 2]) @ self.poses[index - 1] if index > 1 else self.start
        return replace(cloud, points=deskew(cloud.points, times, motion))

    def _scan_again(self, index: int) -> Scan:
        loaded = self._load(index)
        if self.deskew:
            self._thin(loaded, index)
        if loaded.scan is None:
            raise FmrError(f"{self.scans.files[index]}: cannot be read again, it has changed; leave out --resume")
        return loaded.scan

    def _whole(self, index: int) -> PointCloud:
        """A frame's scan with all its attributes, for the map."""
        return self._deskewed(read_cloud(self.scans.files[index]), index)

    def _read_first(self) -> np.ndarray:
        try:
            cloud = read_cloud(self.scans.files[0], attributes=self.deskew)
        except CloudFileError as error:
            raise CloudFileError(f"{error}; or leave this first scan out with --start") from None
        if self.deskew:
            scan_times(cloud)  # says before anything is written that points have no times
        return cloud.points

    def _first_motion(self) -> np.ndarray:
        """(4, 4), file units: the second frame to the first by their scans as they are, which are skewed alike."""
        odometry = Odometry(self.odometry.voxel, self.odometry.origin)
        try:
            scans = [odometry.prepare(read_cloud(path, attributes=False).points) for path in self.scans.files[:2]]
            _, second = (odometry.register(scan) for scan in scans)
        except (CloudFileError, RegistrationError):
            return np.eye(4)  # the run itself says what is wrong with them
        return second.pose if second.status == "aligned" else np.eye(4)

    def _settings(self) -> dict[str, Any]:
        """What must be the same in the run that is resumed."""
        return {
            "version": fmr_cli.__version__,
            "files": [str(path) for path in self.scans.files],
            "voxel_size": self.voxel_size,
            "deskew": self.deskew,
        }

    def _read_journal(self) -> list[dict[str, Any]]:
        """The header and the whole lines of an earlier run's journal; empty where there is none."""
        if not self.journal.exists():
            return []
        check_readable(self.journal)
        records = []
        for line in self.journal.read_bytes().split(b"\n")[:-1]:  # what follows the last newline was cut off
            try:
                records.append(json.loads(line))
            except ValueError as error:
                raise FmrError(f"{self.journal}: is damaged ({reason(error)}), leave out --resume") from None
        changed = [name for name, value in self._settings().items() if records and records[0].get(name) != value]
        if changed:
            raise FmrError(
                f"{self.journal}: was begun with other settings ({', '.join(changed)}), use those or leave out --resume"
            )
        return records

    def _open_tables(self) -> list[TextIO]:
        """Poses and residuals, holding what an earlier run has done, open for more."""
        tables: list[TextIO] = []
        for path, head, kind in self._tables():
            with atomic_write(path) as part:
                part.write_text(head + "".join(self._line(kind, i) for i in range(len(self.rows))), "utf-8")
            tables.append(path.open("a", encoding="utf-8", newline=""))
        return tables

    def _tables(self) -> list[tuple[Path, str, str]]:
        tables = [(self.out, "", self.form)] if self.form != "json" else []
        return tables + ([(self.residuals, ",".join(COLUMNS) + "\n", "csv")] if self.residuals else [])

    def _lines(self, index: int) -> list[str]:
        return [self._line(kind, index) for _, _, kind in self._tables()]

    def _line(self, kind: str, index: int) -> str:
        if kind == "csv":
            return csv_line([self.rows[index].get(name, "") for name in COLUMNS])
        pose = self.pose(index)
        if kind == "kitti":
            return " ".join(f"{value + 0.0:.17g}" for value in pose[:3].ravel()) + "\n"
        time_of = float(index) if self.scans.times is None else self.scans.times[index]
        values = [*pose[:3, 3], *quaternion(pose[:3, :3])]
        return f"{time_of:.9f} " + " ".join(f"{value + 0.0:.17g}" for value in values) + "\n"

    def pose(self, index: int) -> np.ndarray:
        """(4, 4): a frame to the first, in the frame that the poses are written in."""
        pose = self.poses[index]
        return pose if self.T_camera_scan is None else self.T_camera_scan @ pose @ np.linalg.inv(self.T_camera_scan)

    def trajectory(self) -> np.ndarray:
        """(n, 4, 4): every frame's ``pose``."""
        return np.stack([self.pose(index) for index in range(len(self.poses))])

    def _close_loops(self) -> None:
        """Both paths into files, and the map again along the closed one."""
        odometry = self.odometry
        sure = np.array([row["status"] == "aligned" for row in self.rows])
        inner = np.stack([odometry.to_voxels(pose) for pose in self.poses])
        self._write_path(self.odometry_out)
        closed, loops = close_loops(inner, sure, self._scan_again)
        self.poses, self.loops = [odometry.to_file(T) for T in closed], len(loops)
        self._write_path(self.out)
        for index in np.flatnonzero(sure) if self.map else []:
            assert self.map
            self.map.add(self._whole(int(index)), self.poses[index], int(index))

    def _write_path(self, path: Path) -> None:
        if self.form != "json":
            with atomic_write(path) as part:
                part.write_text("".join(self._line(self.form, i) for i in range(len(self.rows))), "utf-8")
            return
        frames = [
            {**row, "pose": self.pose(i).tolist()} | ({} if self.scans.times is None else {"time": self.scans.times[i]})
            for i, row in enumerate(self.rows)
        ]
        write_json(path, {"version": fmr_cli.__version__, "frames": frames})

    def _finish(self) -> None:
        if self.loop_closure:
            self._close_loops()
        elif self.form == "json":
            self._write_path(self.out)
        if self.map and self.merged:
            write_cloud(self.merged, self.map.cloud())
        self.journal.unlink(missing_ok=True)

    def summary(self) -> list[str]:
        """What a person wants to know at the end, a line each."""
        length = sum(row["motion"] for row in self.rows)
        residuals = [row["inlier_rmse"] for row in self.rows[1:] if "inlier_rmse" in row]
        lines = [f"{len(self.rows)} frames, path length {length:.6g}, voxel {self.odometry.voxel:g}: {self.out}"]
        if self.loop_closure:
            lines.append(f"{self.loops} loops closed; the path before: {self.odometry_out}")
        if residuals:
            worst = max(self.rows[1:], key=lambda row: row.get("inlier_rmse", 0.0))
            lines.append(
                f"residual: median {np.median(residuals):.4g}, "
                f"worst {worst['inlier_rmse']:.4g} in frame {worst['frame']} ({worst['file']})"
            )
        return lines

    @property
    def uncertain(self) -> list[dict[str, Any]]:
        """The rows of the frames that are not to be trusted."""
        return [row for row in self.rows if row["status"] != "aligned"]


def csv_line(cells: list[Any]) -> str:
    """One line of a CSV file."""
    import io

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def quaternion(R: np.ndarray) -> np.ndarray:
    """(x, y, z, w) of a rotation matrix, w >= 0."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat(canonical=True)
