"""PTX (Leica): text, one or more scans, each with its pose, then x y z intensity and maybe red green blue a line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import fields_of, lost_context
from fmr_cli.io.parts import ScanPart, choose, proper
from fmr_cli.io.stream import COLORS, CloudStream, Wanted
from fmr_cli.io.table import ROWS, Dialect, Lines, open_text, parse
from fmr_cli.io.transforms import as_transform

HEADER = 10  # lines: columns, rows, the scanner's place and axes, and a transform of four rows
MANY, FEW = 1000, 10  # scans after each other of fewer points than a scan has
FIELDS = ("intensity", *COLORS)


def scans(path: Path) -> list[ScanPart]:
    """Name, pose and number of points of each scan; they have no names but their numbers."""
    found: list[Any] = []
    with open_text(path) as file:
        lines = Lines(file)
        while (head := read_header(lines, len(found))) is not None:
            found.append(head)
            skip(lines, head.count)
            if len(found) > MANY and sum(part.count for part in found[-MANY:]) < FEW * MANY:
                raise CloudFileError(f"holds {MANY} scans of fewer than {FEW} points each, it is no PTX")
    return found


def read_header(lines: Lines, number: int) -> ScanPart | None:
    """The next scan's, or None at the end of the file."""
    rows = lines.take(HEADER)
    if not rows.lines:
        return None
    try:
        columns, height = (int(line) for line in rows.lines[:2])
        values = [[float(word) for word in line.split()] for line in rows.lines[2:]]
        if [len(row) for row in values] != [3] * 4 + [4] * 4 or min(columns, height) < 0:
            raise ValueError
        # Written for rows of coordinates: x' = x T
        T = as_transform(np.array(values[4:]).T)
    except (ValueError, CloudFileError) as error:
        why = f" ({error})" if isinstance(error, CloudFileError) else ""
        raise CloudFileError(f"line {rows.numbers[0]}: is no header of a PTX scan{why}") from None
    return ScanPart(f"scan {number + 1}", T, columns * height)


def skip(lines: Lines, count: int) -> None:
    while count and (rows := lines.take(min(ROWS, count))).lines:
        count -= len(rows.lines)
    if count:
        raise CloudFileError(f"ends {count} lines early, it is truncated: copy it again")


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    """All scans after each other, or the one that is wanted. Of several, ``scan`` numbers them from 1."""
    parts = scans(path)
    if not parts:
        raise CloudFileError("holds no scan")
    chosen = choose(parts, wanted.part)
    width: int | None = None
    with open_text(path) as file:
        lines = Lines(file)
        for k in range(max(chosen) + 1):
            part = read_header(lines, k)
            if part is None or k not in chosen:
                skip(lines, parts[k].count)
                continue
            left = part.count
            while left:
                rows = lines.take(min(ROWS, left))
                width = len(rows.lines[0].split()) if width is None else width
                if width not in (3, 4, 7):
                    raise CloudFileError(f"line {rows.numbers[0]}: has {width} columns, a PTX has 4, or 7 with colours")
                dtype = np.dtype([(f"column_{c + 1}", np.float64) for c in range(width)])
                values = parse(rows, dtype, Dialect(width, list(range(width)))).view(np.float64).reshape(-1, width)
                left -= len(rows.lines)
                yield cloud_of(values, part, k + 1 if len(chosen) > 1 else None, wanted.attributes)


def cloud_of(values: np.ndarray, part: ScanPart, number: int | None, attributes: bool) -> PointCloud:
    """Points in the file's frame; those without a return, which are zeros, as NaN."""
    xyz = np.where((values[:, :3] == 0).all(1, keepdims=True), np.nan, values[:, :3])
    kept = {name: values[:, 3 + k].copy() for k, name in enumerate(FIELDS[: values.shape[1] - 3])} if attributes else {}
    if number is not None and attributes:
        kept["scan"] = np.full(len(xyz), number, np.uint16)
    return PointCloud(
        transform_points(part.T_file_scan, xyz), kept, sensor_origin=part.T_file_scan[:3, 3], scan=part.name,
        T_file_scan=part.T_file_scan,
    )  # fmt: skip


def write(path: Path, stream: CloudStream) -> list[str]:
    """Each scan of the stream with its pose, or all points as one, in one column of as many rows as points."""
    survey = stream.survey
    fields, warnings = fields_of(survey, split=True, eight_bit=True)
    colored = all(any(f.of == c and f.dtype == np.uint8 for f in fields) for c in COLORS)
    kept = [f for f in fields if f.of == "intensity" or (colored and f.of in COLORS)]
    lost = [f.name for f in fields if f not in kept and f.of != "scan"]
    warnings += [f".ptx cannot hold the attributes {', '.join(lost)}: left out"] if lost else []
    counts: list[int] = []
    last: object = None
    for cloud in stream:
        if not counts or cloud.scan != last:
            counts.append(0)
            last = cloud.scan
        counts[-1] += len(cloud)
    with path.open("w", encoding="ascii") as file:
        started, last = 0, None
        for cloud in stream:
            if not started or cloud.scan != last:
                T_file_scan = proper(cloud.T_file_scan)
                file.write(f"1\n{counts[started]}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
                file.writelines(" ".join(map(repr, row)) + "\n" for row in T_file_scan.T.tolist())
                T_scan_file, started, last = np.linalg.inv(T_file_scan), started + 1, cloud.scan
            values = {f.of: f.values(cloud).tolist() for f in kept}
            columns = [values.get("intensity", [0.5] * len(cloud))]
            columns += [values[c] for c in COLORS] if colored else []
            points = transform_points(T_scan_file, cloud.points).T.tolist()
            for row in zip(*points, *columns, strict=True):
                file.write(" ".join(map(repr, row)) + "\n")
    return warnings + [w for w in lost_context(survey.head, ".ptx") if "reference" in w]
