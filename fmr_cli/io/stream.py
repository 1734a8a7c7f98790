"""Clouds of any size: read a chunk at a time, as often as is asked, and what has to be known before writing one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from fmr_cli.cloud import PointCloud

CHUNK = 1 << 18  # points that are in memory at a time; with LAS's attributes and their copies about 100 MB
COLORS = ("red", "green", "blue")
Item = TypeVar("Item")
UNTYPED = ("xyz", "csv", "pts", "ptx", "npy", "npz", "kitti")  # formats whose columns have no type of their own


@dataclass
class Column:
    """What all values of one attribute have in common.

    dtype, shape: of the attribute, shape without the number of points. low, high: of what is finite. whole: integers
    only. missing: how many are NaN. by_257: whether all are multiples of 257, as 8-bit colours in LAS are.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    low: float = np.inf
    high: float = -np.inf
    whole: bool = True
    missing: int = 0
    by_257: bool = True

    def look(self, values: np.ndarray) -> None:
        """Takes further values into account."""
        if values.dtype.kind not in "biuf" or values.size == 0:
            return
        if values.dtype.kind == "f":
            finite = np.isfinite(values)
            if not finite.all():
                self.missing += int(np.isnan(values).sum())
                self.whole, values = False, values[finite]
            self.whole = self.whole and bool((values == np.rint(values)).all())
        if values.size:
            # Python's integers where they are some: float64 would round those of 8 bytes
            self.low, self.high = min(self.low, values.min().item()), max(self.high, values.max().item())
        if values.dtype == np.uint16:
            self.by_257 = self.by_257 and not (values % 257).any()


@dataclass
class Survey:
    """A whole cloud without its points. head: a cloud of no points, with all that is said of the whole.

    count: of points. low, high: (3,) bounds. rest: the most that float32 coordinates would be off, infinite where one
    does not fit. columns: by the attributes' names.
    """

    head: PointCloud
    count: int
    low: np.ndarray
    high: np.ndarray
    rest: float
    columns: dict[str, Column]


class CloudStream:
    """The points of a cloud in order, as clouds of at most some CHUNK points each. Can be run through again.

    All chunks have the same attributes of the same types, and say the same of the whole but for ``dropped``; ``notes``,
    which a reader may make at the end; and where a file has several scans, ``scan``, ``T_file_scan`` and
    ``sensor_origin``. turned: whether it is in another orientation than its file, so that a write has to warn of what
    did not turn along. bare: the same points without their attributes, where that takes less time.
    """

    def __init__(
        self,
        chunks: Callable[[], Iterator[PointCloud]],
        name: str,
        turned: bool = False,
        bare: Callable[[], Iterator[PointCloud]] | None = None,
    ) -> None:
        self.chunks, self.name, self.turned = chunks, name, turned
        self.bare = bare or chunks

    def coordinates(self) -> Iterator[np.ndarray]:
        """The points (n, 3) of each chunk."""
        return (cloud.points for cloud in self.bare())

    def __iter__(self) -> Iterator[PointCloud]:
        return self.chunks()

    def map(self, function: Callable[[PointCloud], PointCloud]) -> CloudStream:
        """Each chunk as the function returns it."""
        return CloudStream(lambda: map(function, self.chunks()), self.name, self.turned)

    def transformed(self, T: np.ndarray) -> CloudStream:
        """The cloud moved by T (4x4), as ``PointCloud.transformed``."""
        moved = self.map(lambda cloud: cloud.transformed(T))
        moved.turned = self.turned or not np.array_equal(T[:3, :3], np.eye(3))
        return moved

    @cached_property
    def survey(self) -> Survey:
        """What is known after one run through all chunks."""
        head: PointCloud | None = None
        count = dropped = 0
        low, high, rest = np.full(3, np.inf), np.full(3, -np.inf), 0.0
        columns: dict[str, Column] = {}
        notes: dict[str, None] = {}  # in order, each once
        for chunk in self:
            if head is None:
                head = chunk.select(slice(0, 0))
                columns = {name: Column(v.dtype, v.shape[1:]) for name, v in chunk.attributes.items()}
            elif chunk.scan != head.scan:
                head.scan = head.T_file_scan = head.sensor_origin = None
            notes |= dict.fromkeys(chunk.notes)
            dropped += chunk.dropped
            count += len(chunk)
            if not len(chunk):
                continue
            ends = np.array(
                [[axis.min(), axis.max()] for axis in chunk.points.T]
            )  # ten times as fast as min(0), max(0)
            low, high = np.minimum(low, ends[:, 0]), np.maximum(high, ends[:, 1])
            with np.errstate(over="ignore", invalid="ignore"):
                off = float(np.abs(chunk.points - chunk.points.astype(np.float32)).max())
            rest = max(rest, off if np.isfinite(off) else np.inf)
            for name, column in columns.items():
                column.look(chunk.attributes[name])
        if head is None:
            raise ValueError("a stream without a single chunk")
        if head.format in UNTYPED:
            narrow_colors(columns)
        return Survey(replace(head, dropped=dropped, notes=(*notes,)), count, low, high, rest, columns)


def narrow_colors(columns: dict[str, Column]) -> None:
    """Gives colours that are integers from 0 to 255 (or 65535) their usual type, whatever the file holds them as."""
    present = [columns[name] for name in (*COLORS, "alpha") if name in columns]
    if not all(c.dtype.kind in "iuf" and c.whole and c.low >= 0 and c.high <= 65535 for c in present):
        return
    for column in present:
        column.dtype = np.dtype(np.uint8 if max(c.high for c in present) <= 255 else np.uint16)


def ahead(items: Iterator[Item]) -> Iterator[Item]:
    """The same items; the next one is made in a thread while one is worked on."""
    with ThreadPoolExecutor(1, "read") as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def stream_of(cloud: PointCloud | CloudStream) -> CloudStream:
    """A cloud in memory, chunk by chunk."""
    if isinstance(cloud, CloudStream):
        return cloud

    def chunks() -> Iterator[PointCloud]:
        for start in range(0, max(len(cloud), 1), CHUNK):
            yield replace(cloud.select(slice(start, start + CHUNK)), dropped=0 if start else cloud.dropped)

    return CloudStream(chunks, cloud.name)


def collect(chunks: Iterable[PointCloud], at_most: int | None = None, seed: int = 0) -> PointCloud:
    """All points as one cloud, or between ``at_most`` and twice as many, spread evenly over the order they come in.

    Every other point is let go whenever too many are there: whichever of each two, by chance that ``seed`` fixes.
    """
    rng = np.random.default_rng(seed)
    parts: list[PointCloud] = []
    held = total = dropped = 0
    stride = 1  # one point is kept of so many
    for chunk in chunks:
        dropped, total = dropped + chunk.dropped, total + len(chunk)
        parts.append(chunk if stride == 1 else chunk.select(one_of_each(len(chunk), stride, rng)))
        held += len(parts[-1])
        if at_most is not None and held > 2 * at_most:
            stride *= 2
            parts = [part.select(one_of_each(len(part), 2, rng)) for part in parts]
            held = sum(map(len, parts))
    if not parts:
        raise ValueError("a stream without a single chunk")
    first = parts[0]
    if any(part.scan != first.scan for part in parts):
        first = replace(first, scan=None, T_file_scan=None, sensor_origin=None)
    attributes = {name: joined([part.attributes.pop(name) for part in parts]) for name in [*parts[0].attributes]}
    points = joined([part.points for part in parts])
    notes = dict.fromkeys(note for part in parts for note in part.notes)
    cloud = replace(first, points=points, attributes=attributes, dropped=dropped, notes=(*notes,))
    cloud.total = first.total or (total if len(cloud) < total else None)
    if cloud.format in UNTYPED and set(COLORS) & set(attributes):
        columns = {name: Column(v.dtype, v.shape[1:]) for name, v in attributes.items() if name in (*COLORS, "alpha")}
        for name, column in columns.items():
            column.look(attributes[name])
        narrow_colors(columns)
        cloud.attributes |= {name: attributes[name].astype(c.dtype, copy=False) for name, c in columns.items()}
    return cloud


def joined(parts: list[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def one_of_each(count: int, stride: int, rng: np.random.Generator) -> np.ndarray:
    """Indices below ``count``: one at random from each ``stride`` in a row."""
    starts = np.arange(0, count, stride)
    return np.minimum(starts + rng.integers(0, stride, len(starts)), count - 1)


@dataclass(frozen=True)
class Wanted:
    """What of a file is to be read. part: which scan of several, a number from 1 or a name. bin_columns: of a .bin.

    bounds: low x y z and high x y z, file's unit; a reader that cannot seek may give more. resolution: of a COPC, the
    spacing of points that is enough. at_most: so many points are enough, if spread evenly. topic: of a bag.
    """

    attributes: bool = True
    part: str | None = None
    bin_columns: tuple[str, ...] | None = None
    bounds: tuple[float, ...] | None = None
    resolution: float | None = None
    at_most: int | None = None
    topic: str | None = None
