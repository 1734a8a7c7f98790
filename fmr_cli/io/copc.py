"""COPC: LAZ files whose chunks are the cells of an octree, so that a part of space, or a coarse level, is read alone.

https://copc.io. The octree's cells stand in pages; a page may point to others.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np

from fmr_cli.errors import CloudFileError
from fmr_cli.io.stream import CHUNK, Wanted

ENTRY = struct.Struct("<iiiiQii")  # level, x, y, z; offset, bytes, points: of a cell, or -1 points: of a page
DEEPEST = 40  # levels: cells of a millionth of a millionth of the whole


@dataclass(frozen=True)
class Cell:
    """A chunk of points. low, high: (3,) the cube they lie in, file's unit."""

    level: int
    low: np.ndarray
    high: np.ndarray
    offset: int
    size: int
    count: int


def info_of(header: laspy.LasHeader) -> Any | None:
    """The record that makes a LAZ file a COPC, or None."""
    found = header.vlrs.get("CopcInfoVlr")
    return found[0] if found else None


def cells_of(file: BinaryIO, info: Any, size: int, chunks: Collection[tuple[int, int, int]]) -> list[Cell]:
    """All cells that hold points, in the file's order. Raises CloudFileError where the octree is damaged.

    size: of the file in bytes. chunks: its LAZ chunks, each by its place, bytes and points: cells are some of them.
    """
    damaged = CloudFileError("has a damaged COPC octree: copy it again, or read it as plain LAZ without bounds")
    found: list[Cell] = []
    pages = [(info.hierarchy_root_offset, info.hierarchy_root_size)]
    seen = set(pages)
    while pages:
        offset, length = pages.pop()
        if length < 0 or offset + length > size or length % ENTRY.size:
            raise damaged
        file.seek(offset)
        for level, x, y, z, start, count_bytes, count in ENTRY.iter_unpack(file.read(length)):
            if count == 0:
                continue
            page = count == -1
            known = page or (start, count_bytes, count) in chunks
            if not 0 <= level <= DEEPEST or not known or (start, count_bytes) in seen:
                raise damaged
            seen.add((start, count_bytes))
            if page:
                pages.append((start, count_bytes))
            else:
                side = 2 * info.halfsize / 2**level
                low = info.center - info.halfsize + np.array([x, y, z]) * side
                found.append(Cell(level, low, low + side, start, count_bytes, count))
    return sorted(found, key=lambda cell: cell.offset)


def wanted_cells(cells: list[Cell], info: Any, wanted: Wanted) -> list[Cell]:
    """Those within the bounds, down to the level of the resolution.

    Where points at most are wanted, down to the level with which there are enough.
    """
    if wanted.bounds is not None:
        low, high = np.array(wanted.bounds[:3]), np.array(wanted.bounds[3:])
        cells = [cell for cell in cells if (cell.low <= high).all() and (cell.high >= low).all()]
    if wanted.resolution is not None:
        deepest = max(0, math.ceil(math.log2(info.spacing / wanted.resolution)))
        cells = [cell for cell in cells if cell.level <= deepest]
    if wanted.at_most is not None:
        held = 0
        for level in sorted({cell.level for cell in cells}):
            held += sum(cell.count for cell in cells if cell.level == level)
            if held >= wanted.at_most:
                return [cell for cell in cells if cell.level <= level]
    return cells


def records(
    file: BinaryIO, header: laspy.LasHeader, cells: list[Cell], selection: laspy.DecompressionSelection
) -> Iterator[laspy.ScaleAwarePointRecord]:
    """The points of the cells, some CHUNK at a time."""
    laszip = header.vlrs.get("LasZipVlr")[0].record_data
    width = header.point_format.size
    for group in grouped(cells):
        packed = bytearray()
        for cell in group:
            file.seek(cell.offset)
            packed += file.read(cell.size)
        plain = np.zeros(sum(cell.count for cell in group) * width, np.uint8)
        table = [(cell.count, cell.size) for cell in group]
        lazrs.decompress_points_with_chunk_table(packed, laszip, plain, table, selection.to_lazrs())
        point = laspy.point.record.PackedPointRecord.from_buffer(plain, header.point_format)
        yield laspy.ScaleAwarePointRecord(point.array, point.point_format, header.scales, header.offsets)


def grouped(cells: list[Cell]) -> Iterator[list[Cell]]:
    """Cells that together hold CHUNK points or some more."""
    group: list[Cell] = []
    for cell in cells:
        group.append(cell)
        if sum(c.count for c in group) >= CHUNK:
            yield group
            group = []
    if group:
        yield group
