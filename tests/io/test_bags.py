"""Bags of ROS: each cloud of a topic is a scan; fields of the common drivers; what is wrong is said in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from benchmarks.bag_files import HESAI, LIVOX, OUSTER, VELODYNE, records, write_bag
from fmr_cli.errors import CloudFileError
from fmr_cli.io import folders, read_cloud, scan_paths, scans_of, write_cloud
from fmr_cli.io.parts import with_topic
from fmr_cli.multiway.scans import list_scans
from fmr_cli.sequence import find_scans
from fmr_cli.sequence.deskew import scan_times

KINDS = ("a.bag", "a.mcap", "a")


def scans(count: int = 3, points: int = 500) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.normal(size=(points, 3)).astype(np.float32) * 10 + k for k in range(count)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("layout", [OUSTER, VELODYNE, HESAI, LIVOX], ids=["ouster", "velodyne", "hesai", "livox"])
def test_each_cloud_is_a_scan(tmp_path: Path, kind: str, layout: np.dtype) -> None:
    given = scans()
    bag = write_bag(tmp_path / kind, {"/lidar": [records(layout, p) for p in given]})
    parts = scans_of(bag)
    assert [part.name for part in parts] == [f"1700000000.{k}00000000" for k in range(3)]
    for k, path in enumerate(scan_paths(bag)):
        cloud = read_cloud(path)
        assert np.array_equal(cloud.points, given[k])
        assert {*cloud.attributes} == {*(layout.names or ())} - {*"xyz"}
        assert all(v.dtype == layout[name] for name, v in cloud.attributes.items())
        times = scan_times(cloud)  # as --deskew takes them
        assert (times[0], times[-1]) == (0, 1)
    whole = read_cloud(bag)
    assert np.array_equal(whole.points, np.concatenate(given))
    assert np.array_equal(whole.attributes["scan"], np.repeat([1, 2, 3], 500))
    assert whole.left_out == ("1 other topics",)
    assert np.array_equal(read_cloud(f"{bag}#1700000000.100000000").points, given[1])


def test_clouds_whose_fields_have_other_widths(tmp_path: Path) -> None:
    """Found by the fuzzer: an attribute of one value in one cloud, of two in the next."""
    (points,) = scans(1)
    rows = [np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("a", "f4", more)]) for more in ((), (2,))]
    bag = write_bag(tmp_path / "a.mcap", {"/lidar": rows})
    with pytest.raises(CloudFileError, match=r"has clouds of other fields from 1700000000\.1"):
        read_cloud(bag)


@pytest.mark.parametrize("kind", KINDS)
def test_several_topics_are_told_apart(tmp_path: Path, kind: str) -> None:
    first, second = scans(2)
    bag = write_bag(tmp_path / kind, {
        "/front/points": [records(VELODYNE, first)], "/rear/points": [records(OUSTER, second)] * 2,
    })  # fmt: skip
    with pytest.raises(CloudFileError, match="several topics, give one by --topic: /front/points, /rear/points"):
        read_cloud(bag)
    with pytest.raises(CloudFileError, match="no clouds on the topic '/chatter'; there are /front"):
        scans_of(bag, "/chatter")
    paths = scan_paths(bag, "/rear/points")
    assert [path.name for path in paths] == [f"{bag.name}#:rear:points:{k}" for k in (1, 2)]
    assert np.array_equal(read_cloud(paths[1]).points, second)


def test_organised_clouds_with_padding_behind_their_rows(tmp_path: Path) -> None:
    given = scans(1, 480)[0]
    bag = write_bag(tmp_path / "a.mcap", {"/lidar": [records(VELODYNE, given)]}, height=16, padding=6)
    assert np.array_equal(read_cloud(bag).points, given)


def test_what_is_wrong_with_a_bag_is_one_line(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "a.bag", {"/lidar": [records(VELODYNE, scans(1)[0])]})
    with pytest.raises(CloudFileError, match="has no scan '9'; there are 1"):
        read_cloud(f"{bag}#9")
    with pytest.raises(CloudFileError, match=r"cannot write|cannot be written"):
        write_cloud(tmp_path / "b.bag", read_cloud(bag))
    (tmp_path / "cut.bag").write_bytes(bag.read_bytes()[:2000])
    with pytest.raises(CloudFileError, match="is no bag that can be read"):
        read_cloud(tmp_path / "cut.bag")
    empty = write_bag(tmp_path / "b.mcap", {})
    with pytest.raises(CloudFileError, match="has no topic of PointCloud2"):
        read_cloud(empty)


def test_a_bag_is_a_sequence_and_material_for_training(tmp_path: Path) -> None:
    given = scans(4)
    bag = write_bag(tmp_path / "drive.mcap", {"/a": [records(OUSTER, p) for p in given], "/b": []})
    for path in (bag, with_topic(bag, "/a")):
        found = find_scans(path, step=2)
        assert [found.name(k) for k in range(2)] == (
            ["drive.mcap#1", "drive.mcap#3"] if path == bag else ["drive.mcap#:a:1", "drive.mcap#:a:3"]
        )
        np.testing.assert_allclose(found.times - found.times[0], [0, 0.2], atol=1e-6)
        assert np.array_equal(found.read(1, attributes=False).points, given[2])
        assert len(folders.find_scans([path])) == 4
    names = [scan.name for scan in list_scans([bag])]
    assert names == ["drive_1", "drive_2", "drive_3", "drive_4"]


def test_livox_own_messages(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    point, scan = "livox_ros_driver/msg/CustomPoint", "livox_ros_driver/msg/CustomMsg"
    store.register(get_types_from_msg(
        "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n", point
    ))  # fmt: skip
    store.register(get_types_from_msg(
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
        "livox_ros_driver/CustomPoint[] points\n", scan,
    ))  # fmt: skip
    xyz = scans(1, 50)[0]
    types = store.types
    header = types["std_msgs/msg/Header"](
        seq=0, stamp=types["builtin_interfaces/msg/Time"](sec=1, nanosec=0), frame_id="livox"
    )
    points = [
        types[point](offset_time=k * 1000, x=p[0], y=p[1], z=p[2], reflectivity=k, tag=16, line=k % 6)
        for k, p in enumerate(xyz)
    ]
    message = types[scan](
        header=header, timebase=0, point_num=50, lidar_id=0, rsvd=np.zeros(3, np.uint8), points=points
    )
    with Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/livox/lidar", scan, typestore=store)
        writer.write(connection, 10**9, store.serialize_ros1(message, scan))
    cloud = read_cloud(tmp_path / "a.bag")
    assert np.array_equal(cloud.points, xyz)
    assert cloud.attributes["offset_time"][-1] == 49_000
    assert cloud.attributes["intensity"].tolist() == list(range(50))
