"""Scans within one file: which there are, and which is meant by FILE#2 or FILE#name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmr_cli.errors import CloudFileError

METADATA = "metadata.yaml"  # what makes a folder a bag of ROS 2


@dataclass(frozen=True)
class ScanPart:
    """One scan of a file. T_file_scan: (4, 4), its own frame to the file's common one. count: of all its points."""

    name: str
    T_file_scan: np.ndarray
    count: int


def choose(parts: list[ScanPart], wanted: str | None) -> list[int]:
    """The scans that are meant, by place from 0: all, or the one of that number from 1, or of that name.

    A number comes first, so that ``io.scan_paths`` reaches every scan, whatever their names are.
    """
    if wanted is None:
        return list(range(len(parts)))
    if wanted.isascii() and wanted.isdecimal() and 1 <= int(wanted) <= len(parts):
        return [int(wanted) - 1]
    named = [k for k, part in enumerate(parts) if part.name == wanted]
    if len(named) == 1:
        return named
    names = ", ".join(part.name for part in parts[:20])
    what = f"has {len(named)} scans called {wanted!r}, give its number" if named else f"has no scan {wanted!r}"
    raise CloudFileError(f"{what}; there are {len(parts)}: {names}")


def proper(T_file_scan: np.ndarray | None) -> np.ndarray:
    """The pose (4, 4) as one that does not mirror, which the points then do: files know rotations only."""
    T = np.eye(4) if T_file_scan is None else T_file_scan.copy()
    T[:3, :3] *= np.sign(np.linalg.det(T[:3, :3]))
    return T


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a bag of ROS 2, which is then one file to us."""
    return path.is_dir() and (path / METADATA).is_file()


def part_name(number: int, topic: str | None) -> str:
    """What stands behind # for a scan, numbers from 1; a topic's slashes are written as colons."""
    return str(number) if topic is None else f"{topic.replace('/', ':')}:{number}"


def topic_of(part: str | None) -> str | None:
    """The topic that is meant by a part such as :ouster:points, all its scans; None where it is one scan, or none."""
    if part is None or not part.startswith(":") or part.rsplit(":", 1)[1].isdecimal():
        return None
    return part.replace(":", "/")


def with_topic(path: Path, topic: str | None) -> Path:
    """FILE#:topic where a topic is given."""
    return path if topic is None else path.with_name(f"{path.name}#{topic.replace('/', ':')}")


def label_of(path: Path) -> str:
    """What to call a scan: the file's stem, and its part behind that, house_2 of house.e57#2."""
    name, _, part = path.name.partition("#")
    return path.stem if path.exists() or not part else f"{Path(name).stem}_{part.strip(':').replace(':', '_')}"
