"""A COPC file made by hand, since laspy writes none: an octree of three levels, a page of its own below one cell."""

from __future__ import annotations

import io
import struct
from itertools import pairwise
from pathlib import Path

import laspy
import lazrs
import numpy as np

ENTRY = struct.Struct("<iiiiQii")


def write_copc(path: Path, points: np.ndarray, scale: float = 0.001, levels: int = 3, root: int = 1000) -> None:
    """points: (N, 3), of which ``root`` by chance are level 0, eight times as many level 1, the rest deepest."""
    rng = np.random.default_rng(0)
    points = points[rng.permutation(len(points))]
    centre, half = (points.min(0) + points.max(0)) / 2, float(np.ptp(points, axis=0).max()) / 2 * 1.001
    sizes = [root * 8**k for k in range(levels - 1)]
    ends = [0, *np.minimum(np.cumsum(sizes), len(points)).tolist(), len(points)]
    cells: list[tuple[tuple[int, int, int, int], np.ndarray]] = []
    for level, (start, end) in enumerate(pairwise(ends)):
        some = points[start:end]
        place = np.floor((some - centre + half) / (2 * half) * 2**level).astype(int)
        for key in np.unique(place, axis=0):
            cells.append(((level, *map(int, key)), some[(place == key).all(1)]))

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, scale), np.floor(centre)
    record = lazrs.LazVlr.new_for_compression(6, 0, True)
    info = laspy.VLR("copc", 1, "COPC info VLR", bytes(160))
    header.vlrs.extend([info, laspy.VLR("laszip encoded", 22204, "http://laszip.org", record.record_data())])
    header.are_points_compressed = True
    header.point_count = len(points)
    header.mins, header.maxs = points.min(0), points.max(0)
    header.number_of_evlrs = 1
    head = io.BytesIO()
    header.write_to(head, ensure_same_size=False)
    with path.open("w+b") as file:
        file.write(head.getvalue())
        start = file.tell()
        compressor = lazrs.LasZipCompressor(file, record)
        for _, some in cells:
            rows = laspy.ScaleAwarePointRecord.zeros(len(some), header=header)
            rows.x, rows.y, rows.z = some.T
            rows["intensity"] = np.arange(len(some)) % 1000
            compressor.compress_many(np.frombuffer(rows.memoryview(), np.uint8))
            compressor.finish_current_chunk()
        compressor.done()
        file.seek(0, 2)
        evlr = file.tell()
        file.seek(start)
        table = lazrs.read_chunk_table(file, record)
        offsets = start + 8 + np.concatenate([[0], np.cumsum([size for _, size in table])])
        entries = [
            (*key, int(offsets[k]), int(table[k][1]), len(some)) for k, (key, some) in enumerate(cells)
        ]  # fmt: skip
        top = next(e for e in entries if e[0] == 1)
        below = [e for e in entries if e[0] > 0 and tuple(v >> (e[0] - 1) for v in e[1:4]) == top[1:4]]
        page = b"".join(ENTRY.pack(*e) for e in below)
        first = [e for e in entries if e not in below]
        data = evlr + 60
        pointer = (*top[:4], data + ENTRY.size * (len(first) + 1), len(page), -1)
        root_page = b"".join(ENTRY.pack(*e) for e in [*first, pointer])
        file.seek(evlr)
        file.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(root_page) + len(page), b"hierarchy"))
        file.write(root_page + page)
        spacing = 2 * half / 10
        body = struct.pack("<5d2Q2d", *centre, half, spacing, data, len(root_page), 0, 0) + bytes(88)
        file.seek(0)
        at = file.read(start).index(b"copc") + 52
        file.seek(at)
        file.write(body)
        file.seek(235)
        file.write(struct.pack("<QI", evlr, 1))
