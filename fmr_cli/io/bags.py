"""Bags of ROS 1 and ROS 2 (also MCAP and SQLite files alone) by rosbags: each PointCloud2 is a scan in its own frame.

FILE#3 is the third scan of the only topic of clouds, FILE#:ouster:points:3 that of /ouster/points: a topic's slashes
are written as colons, since a part of a path may have none.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import to_cloud, unique
from fmr_cli.io.files import reason
from fmr_cli.io.parts import ScanPart, choose, topic_of
from fmr_cli.io.pcd import unpack_colors
from fmr_cli.io.stream import Wanted

CLOUDS = ("sensor_msgs/msg/PointCloud2",)
LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
LIVOX_POINT = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("offset_time", "u4"), ("intensity", "u1"),
                        ("tag", "u1"), ("line", "u1")])  # fmt: skip


class Bag:
    """An open bag and one of its topics. stamps: when each of its clouds was recorded, nanoseconds."""

    def __init__(self, path: Path, topic: str | None) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise CloudFileError("needs the library rosbags: pip install 'fmr-cli[ros]'") from None
        self.lock = threading.Lock()
        self.reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        try:
            self.reader.open()
        except Exception as error:
            raise CloudFileError(f"is no bag that can be read ({reason(error)}), is it whole?") from error
        self.topic = self.choose(topic)
        self.connections = [c for c in self.reader.connections if c.topic == self.topic]
        others = {c.topic for c in self.reader.connections} - {self.topic}
        self.left_out = (f"{len(others)} other topics",) if others else ()
        with self.lock:
            self.stamps = [stamp for _, stamp, _ in self.reader.messages(self.connections)]

    def choose(self, wanted: str | None) -> str:
        """The topic that is meant: the one given, or the only one that has clouds. Raises CloudFileError."""
        topics = sorted({c.topic for c in self.reader.connections if c.msgtype in CLOUDS + LIVOX and c.msgcount})
        if wanted is not None:
            if wanted not in topics:
                raise CloudFileError(f"has no clouds on the topic {wanted!r}; there are {', '.join(topics) or 'none'}")
            return wanted
        if not topics:
            raise CloudFileError("has no topic of PointCloud2 messages")
        if len(topics) > 1:
            raise CloudFileError(f"has clouds on several topics, give one by --topic: {', '.join(topics)}")
        return topics[0]

    def cloud(self, index: int, attributes: bool) -> PointCloud:
        """One of its clouds, from 0."""
        stamp = self.stamps[index]
        place = index - self.stamps.index(stamp)  # of those that were recorded at once
        with self.lock:
            found = [m for m in self.reader.messages(self.connections, start=stamp, stop=stamp + 1)][place]
        connection, _, data = found
        message: Any = self.reader.deserialize(data, connection.msgtype)
        cloud = livox_cloud(message, attributes) if connection.msgtype in LIVOX else cloud_of(message, attributes)
        cloud.sensor_origin, cloud.left_out = np.zeros(3), self.left_out
        cloud.scan, cloud.T_file_scan = seconds(stamp), np.eye(4)
        return cloud


@lru_cache(maxsize=4)
def bag_of(path: Path, changed: int, topic: str | None) -> Bag:
    return Bag(path, topic)


def opened(path: Path, topic: str | None) -> Bag:
    """The bag, kept open for its next scan. ``topic``: as ROS writes it."""
    return bag_of(path.resolve(), path.stat().st_mtime_ns, topic)


def seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def scans(path: Path, topic: str | None = None) -> list[ScanPart]:
    """Its clouds, named by the seconds at which they were recorded; how many points they have is not known before."""
    return [ScanPart(seconds(stamp), np.eye(4), 0) for stamp in opened(path, topic).stamps]


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud]:
    """All clouds after each other, or the one that is wanted. Of several, ``scan`` numbers them from 1."""
    topic, part = wanted.topic, wanted.part
    if (whole := topic_of(part)) is not None:
        topic, part = whole, None
    elif part is not None and part.startswith(":"):
        name, part = part.rsplit(":", 1)
        topic = name.replace(":", "/")
    bag = opened(path, topic)
    if not bag.stamps:
        raise CloudFileError(f"has no clouds on {bag.topic}")
    parts = [ScanPart(seconds(stamp), np.eye(4), 0) for stamp in bag.stamps]
    chosen = choose(parts, part)
    kinds: dict[str, tuple[np.dtype, tuple[int, ...]]] | None = None
    for index in chosen:
        cloud = bag.cloud(index, wanted.attributes)
        found = {name: (values.dtype, values.shape[1:]) for name, values in cloud.attributes.items()}
        if kinds is not None and found != kinds:
            raise CloudFileError(f"has clouds of other fields from {parts[index].name} on: read them one by one")
        kinds = found
        if len(chosen) > 1 and wanted.attributes:
            cloud.attributes["scan"] = np.full(len(cloud), index + 1, np.uint32)
        yield cloud


def cloud_of(message: Any, attributes: bool) -> PointCloud:
    """A sensor_msgs/PointCloud2. Raises CloudFileError where its fields do not fit into its data."""
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        kind = TYPES.get(field.datatype)
        count = max(int(field.count), 1)
        if kind is None or field.offset + np.dtype(kind).itemsize * count > message.point_step:
            raise CloudFileError(f"has a damaged PointCloud2: its field {field.name!r} does not fit into a point")
        names.append(field.name)
        formats.append((order + kind, (count,)) if count > 1 else order + kind)
        offsets.append(field.offset)
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    data = np.frombuffer(message.data, np.uint8)
    row = int(message.row_step) or width * step
    if row < width * step or (height and (height - 1) * row + width * step > len(data)):
        raise CloudFileError(f"has a damaged PointCloud2: {len(data)} bytes for {height} x {width} points of {step}")
    dtype = np.dtype({"names": unique(names), "formats": formats, "offsets": offsets, "itemsize": step})
    if height > 1 and row != width * step:
        data = np.concatenate([data[k * row : k * row + width * step] for k in range(height)])
    records = np.frombuffer(data.tobytes(), dtype, height * width)
    columns = {name: records[name] for name in dtype.names or ()}
    return to_cloud(unpack_colors(columns) if attributes else columns, attributes)


def livox_cloud(message: Any, attributes: bool) -> PointCloud:
    """A CustomMsg of Livox's drivers: reflectivity as intensity, times in nanoseconds since the scan's first point."""
    records = np.array(
        [(p.x, p.y, p.z, p.offset_time, p.reflectivity, p.tag, p.line) for p in message.points], LIVOX_POINT
    )
    return to_cloud({name: records[name] for name in LIVOX_POINT.names or ()}, attributes)
