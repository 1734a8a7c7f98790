"""Files that hold several scans: E57 and PTX, their poses and names, and one scan as FILE#2 or FILE#name."""

from __future__ import annotations

import re
import uuid
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import CloudFileError
from fmr_cli.io import CloudStream, open_cloud, read_cloud, scan_paths, scans_of, write_cloud


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-50, 50, 3)
    return T


LOCAL = [np.random.default_rng(k).normal(size=(40 + k, 3)).round(4) for k in range(2)]


def write_ptx(path: Path) -> Path:
    """Two scans of two columns, the first point of each without a return."""
    text = ""
    for k, points in enumerate(LOCAL):
        rows = [[0, 0, 0, 0.5, 0, 0, 0], *([*p, 0.25, 9, 8, k] for p in points.tolist())]
        rows += [[0, 0, 0, 0.5, 0, 0, 0]] * (len(rows) % 2)
        text += f"2\n{len(rows) // 2}\n1 2 3\n1 0 0\n0 1 0\n0 0 1\n"
        text += "".join(" ".join(map(repr, row)) + "\n" for row in pose(k).T.tolist())
        text += "".join(" ".join(map(str, row)) + "\n" for row in rows)
    path.write_text(text)
    return path


def write_e57(path: Path) -> Path:
    """Two scans by pye57, 'hall' and 'stairs', the second with invalid points."""
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as file:
        for k, points in enumerate(LOCAL):
            data = {f"cartesian{a}": points[:, i].copy() for i, a in enumerate("XYZ")}
            data["intensity"] = np.full(len(points), 0.25)
            data |= {c: np.full(len(points), 7 + k, np.uint8) for c in ("colorRed", "colorGreen", "colorBlue")}
            if k:
                data["cartesianInvalidState"] = (np.arange(len(points)) < 3).astype(np.int8)
            q = np.roll(Rotation.from_matrix(pose(k)[:3, :3]).as_quat(), 1)
            file.write_scan_raw(data, name=("hall", "stairs")[k], rotation=q, translation=pose(k)[:3, 3])
    return path


@pytest.mark.parametrize("suffix", [".ptx", ".e57"])
def test_all_scans_in_the_files_frame(tmp_path: Path, suffix: str) -> None:
    path = {".ptx": write_ptx, ".e57": write_e57}[suffix](tmp_path / f"a{suffix}")
    parts = scans_of(path)
    assert [part.name for part in parts] == (["hall", "stairs"] if suffix == ".e57" else ["scan 1", "scan 2"])
    for k, part in enumerate(parts):
        np.testing.assert_allclose(part.T_file_scan, pose(k), atol=1e-12)
    cloud = read_cloud(path)
    moved = [transform_points(pose(k), points) for k, points in enumerate(LOCAL)]
    skipped = 3 if suffix == ".e57" else 0
    np.testing.assert_allclose(cloud.points, np.concatenate([moved[0], moved[1][skipped:]]), atol=1e-5)
    assert cloud.dropped == 3  # one padded, two without a return
    assert np.bincount(cloud.attributes["scan"]).tolist() == [0, 40, 41 - skipped]
    assert set(cloud.attributes["intensity"]) == {0.25}
    assert cloud.attributes["blue"].dtype == np.uint8
    assert cloud.sensor_origin is None
    for name in ("2", *(["stairs"] if suffix == ".e57" else [])):
        one = read_cloud(f"{path}#{name}")
        np.testing.assert_allclose(one.points, moved[1][skipped:], atol=1e-5)
        np.testing.assert_allclose(one.sensor_origin, pose(1)[:3, 3])
        assert "scan" not in one.attributes
    with pytest.raises(CloudFileError, match=rf"^{re.escape(str(path))}: has no scan '3'; there are 2: "):
        read_cloud(f"{path}#3")


@pytest.mark.parametrize("suffix", [".ptx", ".e57"])
@pytest.mark.parametrize("target", [".ptx", ".e57"])
def test_poses_move_and_the_scans_stay_as_they_are(tmp_path: Path, suffix: str, target: str) -> None:
    if ".e57" in (suffix, target):
        pytest.importorskip("pye57")
    path = {".ptx": write_ptx, ".e57": write_e57}[suffix](tmp_path / f"a{suffix}")
    T = pose(9)
    write_cloud(tmp_path / f"b{target}", open_cloud(path).transformed(T))
    parts = scans_of(tmp_path / f"b{target}")
    assert [part.name for part in parts] == [p.name for p in scans_of(path)] or target == ".ptx"
    for k, part in enumerate(parts):
        np.testing.assert_allclose(part.T_file_scan, T @ pose(k), atol=1e-9)
        one = read_cloud(f"{tmp_path / f'b{target}'}#{k + 1}")
        local = transform_points(np.linalg.inv(part.T_file_scan), one.points)
        np.testing.assert_allclose(local, LOCAL[k][-len(local) :], atol=1e-5)
    before, after = read_cloud(path), read_cloud(tmp_path / f"b{target}")
    np.testing.assert_allclose(after.points, transform_points(T, before.points), atol=1e-5)
    for name, values in before.attributes.items():
        np.testing.assert_array_equal(after.attributes[name], values)


def test_every_attribute_goes_through_an_e57_bit_for_bit(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    rng = np.random.default_rng(0)
    cloud = PointCloud(
        rng.normal(size=(500, 3)) + 6e5,
        {
            "intensity": rng.random(500).astype(np.float32), "nx": rng.random(500),
            "row": np.arange(500, dtype=np.uint16),
            "label": np.arange(500, dtype=np.int32) - 70_000, "timestamp": rng.random(500) + 1.7e9,
            "wide": np.arange(500) + 2**40,
        },
        crs="EPSG:25832",
    )  # fmt: skip
    assert write_cloud(tmp_path / "a.e57", cloud) == []
    back = read_cloud(tmp_path / "a.e57")
    assert np.array_equal(back.points, cloud.points)
    assert back.crs == cloud.crs
    for name, values in cloud.attributes.items():
        assert np.array_equal(back.attributes[name], values), name
    data = pye57.E57(str(tmp_path / "a.e57")).read_scan_raw(0, ignore_unsupported_fields=True)
    assert np.array_equal(data["cartesianX"], cloud.points[:, 0])


def test_spherical_coordinates(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    lib = pye57.libe57
    xyz = np.random.default_rng(0).normal(size=(300, 3))
    reach = np.linalg.norm(xyz, axis=1)
    values = {
        "sphericalRange": reach, "sphericalAzimuth": np.arctan2(xyz[:, 1], xyz[:, 0]),
        "sphericalElevation": np.arcsin(xyz[:, 2] / reach),
        "sphericalInvalidState": (np.arange(300) < 5).astype(np.int8),
    }  # fmt: skip
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as e57:
        file = e57.image_file
        node, prototype = lib.StructureNode(file), lib.StructureNode(file)
        node.set("guid", lib.StringNode(file, str(uuid.uuid4())))
        buffers = lib.VectorSourceDestBuffer()
        for name, array in values.items():
            whole = array.dtype == np.int8
            prototype.set(name, lib.IntegerNode(file, 0, 0, 2) if whole else lib.FloatNode(file, 0.0, lib.E57_DOUBLE))
            buffers.append(lib.SourceDestBuffer(file, name, array, 300, True, True))
        points = lib.CompressedVectorNode(file, prototype, lib.VectorNode(file, True))
        node.set("points", points)
        e57.data3d.append(node)
        writer = points.writer(buffers)
        writer.write(300)
        writer.close()
    cloud = read_cloud(tmp_path / "a.e57")
    np.testing.assert_allclose(cloud.points, xyz[5:], atol=1e-12)
    assert cloud.dropped == 5


def test_a_file_of_that_very_name_wins(tmp_path: Path) -> None:
    cloud = PointCloud(np.eye(3))
    write_cloud(tmp_path / "a#2.ply", cloud)
    assert len(read_cloud(tmp_path / "a#2.ply")) == 3
    write_ptx(tmp_path / "a.ptx#2.ptx")
    assert len(scans_of(tmp_path / "a.ptx#2.ptx")) == 2
    write_cloud(tmp_path / "a.ply", cloud)
    with pytest.raises(CloudFileError, match="holds one scan, take the #2 off its name"):
        read_cloud(f"{tmp_path}/a.ply#2")
    with pytest.raises(CloudFileError, match=r"b\.ptx: no such file"):
        read_cloud(f"{tmp_path}/b.ptx#2")


def test_every_scan_is_reached_whatever_their_names(tmp_path: Path) -> None:
    """Names that are numbers of other scans, a # in a name, two of one name."""
    pytest.importorskip("pye57")
    names = ["2", "hall#2", "1", "hall#2", "007"]
    scans = [PointCloud(np.full((1, 3), k), scan=name, T_file_scan=np.eye(4)) for k, name in enumerate(names)]
    write_cloud(tmp_path / "a.e57", CloudStream(lambda: iter(scans), "made"))
    assert [read_cloud(path).points[0, 0] for path in scan_paths(tmp_path / "a.e57")] == [0, 1, 2, 3, 4]
    assert read_cloud(tmp_path / "a.e57#2").scan == "hall#2"  # by its number
    assert read_cloud(tmp_path / "a.e57#007").scan == "007"
    with pytest.raises(CloudFileError, match="has 2 scans called 'hall#2', give its number"):
        read_cloud(tmp_path / "a.e57#hall#2")


def test_a_ptx_that_ends_early_or_begins_otherwise(tmp_path: Path) -> None:
    path = write_ptx(tmp_path / "a.ptx")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-3]))
    with pytest.raises(CloudFileError, match="ends 3 lines early"):
        read_cloud(path)
    path.write_text("".join(lines[3:]))
    with pytest.raises(CloudFileError, match="line 1: is no header of a PTX scan"):
        read_cloud(path)
