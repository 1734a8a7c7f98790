"""What the user knows beforehand: links, poses, scans that don't move, the scan whose frame is the common one."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.io import read_transform, scans_of
from fmr_cli.io.files import check_readable, reason
from fmr_cli.io.transforms import as_transform
from fmr_cli.multiway.scans import Scan

USES = ("known", "try", "never")
ROUGH_DEGREES, ROUGH_SHARE = 10.0, 0.1  # sigma of a pose without one: degrees, share of the scan's radius


@dataclass(frozen=True)
class KnownLink:
    """use: "known" (T_target_source is given and not registered), "try" (first of all, from T where given), "never"."""

    source: str
    target: str
    use: str = "try"
    T_target_source: np.ndarray | None = None


@dataclass(frozen=True)
class KnownPose:
    """T_world_scan between files' coordinates; sigmas: degrees and file's unit, or None for a rough guess."""

    T_world_scan: np.ndarray
    sigma_rot_deg: float | None = None
    sigma_shift: float | None = None


@dataclass(frozen=True)
class Known:
    """What is known beforehand; scans by name, file name or path.

    fixed: scans that don't move: where ``poses`` has them, else where their files do. anchor: its frame is that of its
    component.
    """

    links: Sequence[KnownLink] = ()
    poses: Mapping[str, KnownPose] = field(default_factory=dict)
    fixed: Sequence[str] = ()
    anchor: str | None = None


def read_links(path: Path) -> list[KnownLink]:
    """Columns source, target and optionally transform (a file, relative to this one, or 12 numbers) and use."""
    links = []
    for number, row in rows(path, {"source", "target"}):
        where = f"{path}: line {number}"
        T = transform(row["transform"], path.parent, where) if row.get("transform") else None
        use = row.get("use") or ("known" if T is not None else "try")
        if use not in USES:
            raise CloudFileError(f"{where}: use is {use!r}, write one of {', '.join(USES)}")
        if use == "known" and T is None:
            raise CloudFileError(f"{where}: a known link needs its transform, fill it in")
        links.append(KnownLink(row["source"], row["target"], use, T))
    return links


def read_init_poses(path: Path) -> dict[str, KnownPose]:
    """Columns scan, pose (a file, relative to this one, or 12 numbers), optionally sigma_rot_deg and sigma_shift."""
    poses: dict[str, KnownPose] = {}
    for number, row in rows(path, {"scan", "pose"}):
        where = f"{path}: line {number}"
        sigmas = []
        for name in ("sigma_rot_deg", "sigma_shift"):
            try:
                sigma = float(row[name]) if row.get(name) else None
            except ValueError:
                sigma = -1.0
            if sigma is not None and not 0 <= sigma < np.inf:
                raise CloudFileError(f"{where}: {name} is {row[name]!r}, write a number from 0, or nothing")
            sigmas.append(sigma)
        if row["scan"] in poses:
            raise CloudFileError(f"{where}: {row['scan']} has a pose already, keep one of them")
        poses[row["scan"]] = KnownPose(transform(row["pose"], path.parent, where), *sigmas)
    return poses


def rows(path: Path, needed: set[str]) -> list[tuple[int, dict[str, str]]]:
    """The lines of a CSV file with their numbers, each with the columns ``needed`` filled in. Raises CloudFileError."""
    check_readable(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except (csv.Error, UnicodeDecodeError) as error:
        raise CloudFileError(f"{path}: is no CSV file ({reason(error)}), check how it was written") from None
    columns = [cell.strip() for cell in lines[0][1]] if lines else []
    if not needed <= set(columns):
        said = ", ".join(columns)[:100] or "nothing"
        raise CloudFileError(f"{path}: its first line must name the columns {', '.join(sorted(needed))}, found {said}")
    if len(lines) == 1:
        raise CloudFileError(f"{path}: holds no line below the columns, fill it in or leave the option away")
    found = []
    for number, row in lines[1:]:
        cells = dict(zip(columns, (cell.strip() for cell in row), strict=False))
        for name in sorted(needed):
            if not cells.get(name):
                raise CloudFileError(f"{path}: line {number}: {name} is missing, fill it in")
        found.append((number, cells))
    return found


def transform(text: str, folder: Path, where: str) -> np.ndarray:
    """A rigid transform from a file's path or from 12 or 16 numbers. Raises CloudFileError."""
    try:
        values = np.array([float(word) for word in text.replace(",", " ").replace(";", " ").split()])
    except ValueError:
        T = read_transform(folder / text)
    else:
        if values.size not in (12, 16):
            raise CloudFileError(f"{where}: {values.size} numbers are no transform, write 12, row by row, or a file")
        try:
            T = as_transform(values)
        except CloudFileError as error:
            raise CloudFileError(f"{where}: {error}") from None
    if abs(np.linalg.det(T[:3, :3]) - 1) > 1e-2:
        raise CloudFileError(f"{where}: has a scale of {np.cbrt(np.linalg.det(T[:3, :3])):.3g}, scans keep theirs")
    U, _, Vt = np.linalg.svd(T[:3, :3])  # the rotation next to it: other tools write few digits
    T[:3, :3] = U @ Vt
    return T


def finder(scans: Sequence[Scan]) -> Mapping[str, int]:
    """A scan's number by its name, path and, where it is the only one so called, file name or stem."""
    found: dict[str, list[int]] = {}
    for number, scan in enumerate(scans):
        path = scan.path
        keys = {scan.name, *([path.name, path.stem, str(path), str(path.resolve())] if path else [])}
        for key in keys:
            found.setdefault(key, []).append(number)
    exact = {scan.name: number for number, scan in enumerate(scans)}
    return {key: exact.get(key, numbers[0]) for key, numbers in found.items() if len(numbers) == 1 or key in exact}


def number_of(name: str, scans: Sequence[Scan], option: str) -> int:
    """The scan that is so called. Raises FmrError, which names the option."""
    known = finder(scans)
    number = known.get(name, known.get(str(Path(name).resolve())))
    if number is None:
        some = ", ".join(scan.name for scan in scans[:5])
        raise FmrError(f"{option}: no scan is called {name}; they are {some}{' ...' if len(scans) > 5 else ''}")
    return number


def poses_in_file(paths: Sequence[Path | None]) -> dict[int, KnownPose]:
    """By place, the known poses of scans that all come from one file which states where each stood.

    Their points are in the file's frame already, so that each pose is the identity, with the usual sigmas.
    """
    names = [path.name.partition("#") for path in paths if path is not None]
    if len(names) < len(paths) or len({name for name, _, _ in names}) > 1 or not all(part for _, _, part in names):
        return {}
    first = next(path for path in paths if path is not None)
    stated = scans_of(first.with_name(names[0][0])) if ":" not in names[0][2] else []
    if all(np.array_equal(part.T_file_scan, stated[0].T_file_scan) for part in stated):
        return {}
    return {number: KnownPose(np.eye(4), None, None) for number in range(len(paths))}
