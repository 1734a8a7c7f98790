"""The scans of a sequence: which files, in which order, at which times, and the calibration that lies beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.io import SUFFIXES, holds_scans, read_cloud, scan_paths, scans_of
from fmr_cli.io.files import check_readable
from fmr_cli.io.folders import natural, stem, times_by_name
from fmr_cli.io.transforms import as_transform, number_rows

TEXT = {".txt", ".csv"}  # beside scans of another format these are poses, times, tables


@dataclass(frozen=True)
class Scans:
    """The scans of a sequence, in order.

    sources: files, or clouds in memory; ``chosen`` are their places among all ``total``. times: (n,), one a scan,
    seconds, or None. T_camera_scan: (4, 4), calib.txt's Tr, or None. notes: what a person should know about the choice,
    a line each. every: all the files, where only some are chosen.
    """

    sources: list[Path | PointCloud]
    chosen: range
    total: int
    times: np.ndarray | None = None
    T_camera_scan: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    every: list[Path] = field(default_factory=list)

    @property
    def all_sources(self) -> list[Path | PointCloud]:
        """Those of all ``total`` scans."""
        return list(self.every) or self.sources

    def __len__(self) -> int:
        return len(self.sources)

    def name(self, index: int) -> str:
        """The scan's file name, for tables."""
        path = self.path(index)
        return path.name if path else f"scan {self.chosen[index]}"

    def path(self, index: int) -> Path | None:
        """The scan's file, where it has one."""
        source = self.sources[index]
        return source.path if isinstance(source, PointCloud) else source

    def read(self, index: int, *, attributes: bool) -> PointCloud:
        """One scan. Raises CloudFileError."""
        source = self.sources[index]
        return source if isinstance(source, PointCloud) else read_cloud(source, attributes=attributes)

    def pace(self, index: int) -> float:
        """The time from the scan before to this one, over that before it; 1 where it is not known."""
        if self.times is None or index < 2:
            return 1.0
        before, after = np.diff(self.times[index - 2 : index + 1])
        return float(after / before) if before else 1.0

    def where(self, index: int) -> str:
        """The scan's path, or what stands for it in a message."""
        return str(self.path(index) or self.name(index))


def as_scans(scans: Scans | str | Path | Iterable[str | Path | PointCloud]) -> Scans:
    """What a caller may give for a sequence: what ``find_scans`` takes, or files or clouds in their order.

    Raises CloudFileError, and FmrError where there are fewer than two.
    """
    if isinstance(scans, Scans):
        return scans
    if isinstance(scans, str | Path):
        return find_scans(Path(scans))
    sources: list[Path | PointCloud] = [s if isinstance(s, PointCloud) else Path(s) for s in scans]
    if len(sources) < 2:
        raise FmrError(f"{len(sources)} scans: a sequence has two or more")
    return Scans(sources, range(len(sources)), len(sources))


def find_scans(
    path: Path, start: int = 0, stop: int | None = None, step: int = 1, outputs: Iterable[Path] = ()
) -> Scans:
    """The scans of a folder, a KITTI sequence or raw drive, a bag, or a text file that lists them.

    Of any other file that holds several, too. start, stop, step: as in a slice, counted over all scans. outputs: files
    that are no scans, wherever they lie. Raises CloudFileError where there are fewer than two.
    """
    notes: list[str] = []
    home = path
    in_file = holds_scans(path)
    if in_file:
        files = scan_paths(path)
    elif path.is_dir():
        folder = next((f for f in (path / "velodyne", path / "velodyne_points" / "data") if f.is_dir()), path)
        home = path.parent if folder is path and path.name == "velodyne" else path
        files = in_folder(folder, {p.resolve() for p in outputs}, notes)
    elif path.suffix.lower() in ("", ".txt", ".lst", ".list"):
        files = in_list(path)
    else:
        check_readable(path)
        raise CloudFileError(f"{path}: is one file, give a folder of scans, a bag, or a .txt that lists them")
    chosen = range(len(files))[start:stop:step]
    if len(chosen) < 2:
        what = f"{len(files)} scans, {len(chosen)} of them chosen" if len(chosen) < len(files) else "one scan only"
        raise CloudFileError(f"{path}: {what}, a sequence has two or more (formats: {' '.join(SUFFIXES)})")
    times = read_times(home, len(files)) if path.is_dir() and not in_file else None
    if times is None:
        times = times_by_name([part.name for part in scans_of(path)] if in_file else [stem(file) for file in files])
    times = None if times is None else in_order(times[np.array(chosen)], [files[i] for i in chosen], notes)
    return Scans([files[i] for i in chosen], chosen, len(files), times, read_calibration(home), notes, files)


def in_folder(folder: Path, outputs: set[Path], notes: list[str]) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.name[0] != "." and p.is_file()]
    found = [p for p in found if p.resolve() not in outputs]
    found = [p for p in found if p.suffix.lower() not in TEXT] or found
    count = Counter(p.suffix.lower() for p in found)
    if not count:
        raise CloudFileError(f"{folder}: holds no scans, expected files ending in {' '.join(SUFFIXES)}")
    suffix = max(sorted(count), key=lambda s: count[s])
    if len(count) > 1:
        others = ", ".join(f"{n} {s}" for s, n in sorted(count.items()) if s != suffix)
        notes.append(f"{folder}: two formats, the {count[suffix]} {suffix} files are taken, {others} left out")
    return sorted((p for p in found if p.suffix.lower() == suffix), key=lambda file: natural(stem(file)))


def in_order(times: np.ndarray, files: list[Path], notes: list[str]) -> np.ndarray | None:
    """The times (n,), or None where they run to and fro: then they say nothing about the motion between scans."""
    back = np.flatnonzero(~(np.diff(times) >= 0) != ~(times[-1] >= times[0]))
    if len(back):
        notes.append(
            f"{files[back[0] + 1]}: time runs the other way there than from the first scan to the last, so the times "
            "are not used; check the order of the scans"
        )
        return None
    return times


def in_list(path: Path) -> list[Path]:
    """The files that a text file names, one a line, relative to its folder."""
    check_readable(path)
    try:
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines()]
    except UnicodeDecodeError:
        raise CloudFileError(f"{path}: is no text file, give a folder of scans, or a .txt that lists them") from None
    files = [path.parent / line for line in lines if line and not line.startswith("#")]
    missing = next((file for file in files if not file.is_file()), None)
    if missing or not files:
        what = f"lists {missing}, which is not there" if missing else "lists no scans"
        raise CloudFileError(f"{path}: {what}, name one scan file a line")
    return files


def read_times(home: Path, count: int) -> np.ndarray | None:
    """Seconds from times.txt (KITTI odometry) or velodyne_points/timestamps.txt (KITTI raw), or None."""
    odometry, raw = home / "times.txt", home / "velodyne_points" / "timestamps.txt"
    if odometry.is_file():
        times = np.array([row[0] for row in number_rows(odometry)])
    elif raw.is_file():
        try:
            stamps = np.array(raw.read_text("utf-8").split("\n")[:-1], "datetime64[ns]")
        except ValueError as error:
            raise CloudFileError(f"{raw}: is no list of time stamps ({error}), remove it to go without") from None
        times = (stamps - stamps[0]) / np.timedelta64(1, "s") if len(stamps) else np.zeros(0)
    else:
        return None
    if len(times) < count:
        raise CloudFileError(f"{odometry if odometry.is_file() else raw}: {len(times)} times for {count} scans")
    return times


def read_calibration(home: Path) -> np.ndarray | None:
    """KITTI odometry's Tr of calib.txt, scan to left camera, or None where there is none."""
    path = home / "calib.txt"
    if not path.is_file():
        return None
    for line in path.read_text("utf-8", errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_to_cam"):
            try:
                return as_transform(np.array(numbers.split(), dtype=float))
            except (CloudFileError, ValueError) as error:
                raise CloudFileError(f"{path}: {name.strip()}: {error}") from None
    return None
