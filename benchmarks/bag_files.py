"""Bags written by rosbags: PointCloud2 as drivers publish them, in ROS 1, ROS 2 (SQLite) and MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

OUSTER = np.dtype({
    "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "range"],
    "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "u1", "<u4"],
    "offsets": [0, 4, 8, 16, 20, 24, 26, 28], "itemsize": 32,
})  # fmt: skip
VELODYNE = np.dtype({
    "names": ["x", "y", "z", "intensity", "ring", "time"], "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
    "offsets": [0, 4, 8, 12, 16, 18], "itemsize": 22,
})  # fmt: skip
HESAI = np.dtype({
    "names": ["x", "y", "z", "intensity", "timestamp", "ring"], "formats": ["<f4", "<f4", "<f4", "<f4", "<f8", "<u2"],
    "offsets": [0, 4, 8, 16, 24, 32], "itemsize": 48,
})  # fmt: skip
LIVOX = np.dtype({
    "names": ["x", "y", "z", "intensity", "tag", "line", "offset_time"],
    "formats": ["<f4", "<f4", "<f4", "<f4", "u1", "u1", "<u4"], "offsets": [0, 4, 8, 12, 16, 17, 18], "itemsize": 22,
})  # fmt: skip
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def records(layout: np.dtype, points: np.ndarray) -> np.ndarray:
    """A scan (n, 3) as a driver's records; what is no coordinate counts up, times over a tenth of a second."""
    rows = np.zeros(len(points), layout)
    for name in layout.names or ():
        if name in "xyz":
            rows[name] = points[:, "xyz".index(name)]
        elif name in ("t", "offset_time"):
            rows[name] = np.linspace(0, 1e8, len(points))
        elif name == "time":
            rows[name] = np.linspace(0, 0.1, len(points))
        elif name == "timestamp":
            rows[name] = 1.7e9 + np.linspace(0, 0.1, len(points))
        else:
            rows[name] = np.arange(len(points)) % 64
    return rows


def message_of(store: Any, rows: np.ndarray, stamp: int, ros1: bool, height: int = 1, padding: int = 0) -> Any:
    """A PointCloud2 of ``height`` rows with ``padding`` bytes behind each."""
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = {"seq": 0} if ros1 else {}
    layout = rows.dtype
    fields = [
        types["sensor_msgs/msg/PointField"](
            name=name,
            offset=int(layout.fields[name][1]),
            datatype=DATATYPES[layout[name].base.str[1:]],
            count=int(np.prod(layout[name].shape, dtype=int)),
        )
        for name in layout.names
    ]
    width = len(rows) // height
    data = np.frombuffer(rows[: width * height].tobytes(), np.uint8).reshape(height, -1)
    data = np.hstack([data, np.zeros((height, padding), np.uint8)])
    return types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="lidar", **header), height=height, width=width,
        fields=fields, is_bigendian=False, point_step=layout.itemsize, row_step=data.shape[1], data=data.reshape(-1),
        is_dense=True,
    )  # fmt: skip


def write_bag(
    path: Path,
    topics: dict[str, list[np.ndarray]],
    height: int = 1,
    padding: int = 0,
    start: int = 1_700_000_000 * 10**9,
) -> Path:
    """.bag (ROS 1), .mcap, or a folder (ROS 2, SQLite); a scan each tenth of a second on each topic, and one of text.

    Returns the path to read it by.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    folder = path.with_suffix("") if path.suffix == ".mcap" else path
    if ros1:
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(folder, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        word = store.types["std_msgs/msg/String"](data="hello")
        writer.write(text, start, serialize(word, "std_msgs/msg/String"))
        kind = "sensor_msgs/msg/PointCloud2"
        for topic, scans in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, rows in enumerate(scans):
                stamp = start + k * 10**8
                message = message_of(store, rows, stamp, ros1, height, padding)
                writer.write(connection, stamp, serialize(message, kind))
    if path.suffix == ".mcap":
        next(folder.glob("*.mcap")).rename(path)
    return path
