"""The clouds that `fmr view` shows: files or the scans of a run, in one frame, and the section through them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.io import read_cloud, read_transform

SLICE = 0.02  # of the size: a section's thickness where none is given


@dataclass(frozen=True)
class Section:
    """A slice of the clouds: along ``axis`` (0 to 2) at ``at``, so thick; own unit."""

    axis: int
    at: float
    thick: float

    def keep(self, points: np.ndarray) -> np.ndarray:
        return np.abs(points[:, self.axis] - self.at) <= self.thick / 2


def read_section(text: str | None, clouds: Sequence[PointCloud]) -> Section | None:
    """A section as given: AXIS, AXIS=AT or AXIS=AT:THICK, such as z=1.5:0.1. Raises FmrError."""
    if text is None:
        return None
    axis, _, rest = text.partition("=")
    at, _, thick = rest.partition(":")
    low, high = box(clouds)
    try:
        number = "xyz".index(axis.strip().lower()) if axis.strip() else -1
        section = Section(
            number,
            float(at) if at else float(np.median(np.concatenate([c.points[:, number] for c in clouds]))),
            float(thick) if thick else SLICE * float(np.linalg.norm(high - low)),
        )
    except ValueError:
        number = -1
    if number < 0 or not section.thick > 0 or not np.isfinite([section.at, section.thick]).all():
        raise FmrError(f"--section {text}: give an axis and where to cut, such as z, z=1.5 or z=1.5:0.1 (0.1 thick)")
    return section


def box(clouds: Sequence[PointCloud]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (3,) of all clouds."""
    return np.min([c.points.min(0) for c in clouds], axis=0), np.max([c.points.max(0) for c in clouds], axis=0)


def load(
    files: Sequence[Path], transform: Path | None, result: Path | None, at_most: int
) -> tuple[list[PointCloud], list[str]]:
    """The clouds in one frame, at most so many points together, and what a person should know.

    transform: moves the first file. result: the folder of a multiway run, whose poses move the scans (all of them where
    no file is named), or of a batch, whose pair of two files it is. Raises FmrError.
    """
    notes: list[str] = []
    poses: list[np.ndarray] = [np.eye(4)] * len(files)
    if result is not None:
        files, poses, notes = of_result(result, files)
    elif not files:
        raise FmrError("give files to view, or --result with the folder of a run")
    if transform is not None:
        poses = [read_transform(transform), *poses[1:]]
    clouds = []
    for file, T in zip(files, poses, strict=True):
        cloud = read_cloud(file, at_most=max(at_most // len(files) // 2, 1000))
        clouds.append(cloud if np.array_equal(T, np.eye(4)) else cloud.transformed(T))
        if len(cloud) < cloud.count:
            notes.append(f"{file}: {len(cloud)} of {cloud.count} points are shown")
    return clouds, notes


def of_result(folder: Path, files: Sequence[Path]) -> tuple[list[Path], list[np.ndarray], list[str]]:
    """The files of a run and their poses in one frame."""
    if (folder / "network.json").is_file():
        return of_network(folder / "network.json", files)
    if (folder / "results.csv").is_file():
        return of_batch(folder, files)
    raise CloudFileError(f"{folder}: holds neither network.json (fmr multiway) nor results.csv (fmr batch)")


def of_network(path: Path, files: Sequence[Path]) -> tuple[list[Path], list[np.ndarray], list[str]]:
    try:
        scans = json.loads(path.read_text("utf-8"))["scans"]
        known = [(Path(s["file"]), s["component"], s["T_component_scan"], s["name"]) for s in scans]
    except (ValueError, KeyError, TypeError) as error:
        raise CloudFileError(f"{path}: is not what fmr multiway writes ({error})") from None
    wanted = {file.resolve() for file in files}
    chosen = [s for s in known if not wanted or s[0].resolve() in wanted]
    for file in files:
        if file.resolve() not in {s[0].resolve() for s in known}:
            raise CloudFileError(f"{file}: is not among the scans of {path}")
    first = min((s[1] for s in chosen if s[1] is not None), default=None)
    placed = [s for s in chosen if s[1] == first and s[2] is not None]
    if not placed:
        raise CloudFileError(f"{path}: none of these scans is placed")
    left = [s[3] for s in chosen if s not in placed]
    notes = [f"in other frames, not shown: {', '.join(left[:20])}"] if left else []
    return [s[0] for s in placed], [np.array(s[2]) for s in placed], notes


def of_batch(folder: Path, files: Sequence[Path]) -> tuple[list[Path], list[np.ndarray], list[str]]:
    import csv

    if len(files) != 2:
        raise FmrError(f"{folder}: of a batch one pair is shown, give its SOURCE and TARGET")
    with (folder / "results.csv").open(encoding="utf-8", newline="") as table:
        for row in csv.DictReader(table):
            names = [Path(row.get("source") or "").name, Path(row.get("target") or "").name]
            if names == [file.name for file in files] and row.get("transform"):
                return list(files), [read_transform(folder / row["transform"]), np.eye(4)], []
    raise CloudFileError(f"{folder / 'results.csv'}: has no transform of {files[0].name} onto {files[1].name}")
