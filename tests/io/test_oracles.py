"""Other programs as oracles: they read what fmr writes, and fmr reads what they write. Each is skipped where it is not.

laspy and pye57 write and read in the tests of LAS and E57 themselves.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.evaluation.open3d_import import Open3DError, open3d
from fmr_cli.io import read_cloud, write_cloud

COLORS, NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")


@pytest.fixture
def cloud() -> PointCloud:
    """300 points, exact in float32, with colours, normals, an intensity and labels."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(300, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    colors = rng.integers(0, 256, (300, 3)).astype(np.uint8)
    return PointCloud(rng.integers(-40_000, 40_000, (300, 3)) / 1024, {
        "intensity": rng.random(300).astype(np.float32), **dict(zip(NORMALS, normals.T, strict=True)),
        **dict(zip(COLORS, colors.T, strict=True)), "label": rng.integers(-9, 9, 300).astype(np.int32),
    })  # fmt: skip


def same(a: PointCloud, b: PointCloud, names: tuple[str, ...], close: float = 0) -> None:
    np.testing.assert_allclose(a.points, b.points, rtol=0, atol=close)
    for name in names:
        np.testing.assert_allclose(a.attributes[name], b.attributes[name], rtol=0, atol=close, err_msg=name)


def test_plyfile_reads_what_is_written(tmp_path: Path, cloud: PointCloud) -> None:
    plyfile = pytest.importorskip("plyfile")
    write_cloud(tmp_path / "a.ply", cloud)
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert np.array_equal(np.stack([vertex[axis] for axis in "xyz"], 1), cloud.points)
    for name, values in cloud.attributes.items():
        assert vertex[name].dtype.newbyteorder("=") == values.dtype
        assert np.array_equal(vertex[name], values)


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_what_plyfile_writes_is_read(tmp_path: Path, cloud: PointCloud, text: bool, order: str) -> None:
    """With an element before the points and a list in them (but big endian: plyfile 1.1 turns no bytes of lists)."""
    plyfile = pytest.importorskip("plyfile")
    names = [*cloud.attributes]
    kinds = [("x", "f4"), ("y", "f8"), ("z", "f4"), *((n, cloud.attributes[n].dtype.str[1:]) for n in names)]
    lists = [("near", object)] if order != ">" else []
    rows = np.zeros(len(cloud), [*kinds, *lists])
    for i, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, i]
    for name in names:
        rows[name] = cloud.attributes[name]
    if lists:
        rows["near"] = [np.arange(k % 4, dtype=np.int32) for k in range(len(cloud))]
    vertex = plyfile.PlyElement.describe(rows, "vertex", val_types={"near": "i4"} if lists else {})
    camera = plyfile.PlyElement.describe(np.zeros(2, [("f", "f4")]), "camera")
    plyfile.PlyData([camera, vertex], text=text, byte_order=order).write(str(tmp_path / "a.ply"))
    back = read_cloud(tmp_path / "a.ply")
    same(back, cloud, tuple(names), close=1e-6 if text else 0)
    assert back.left_out == (*["list property 'near'"][: len(lists)], "element 'camera'")


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "stl"])
def test_meshes_that_trimesh_writes_are_read(tmp_path: Path, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    colors = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 4)).astype(np.uint8)
    mesh.visual.vertex_colors = colors
    mesh.export(tmp_path / f"a.{suffix}")
    cloud = read_cloud(tmp_path / f"a.{suffix}", mesh_points=0)
    if suffix == "stl":  # three corners a triangle
        assert {*map(tuple, cloud.points.tolist())} == {*map(tuple, mesh.vertices.tolist())}
    else:
        np.testing.assert_allclose(cloud.points, mesh.vertices, atol=1e-6)
    if suffix in ("ply", "obj"):
        seen = np.stack([cloud.attributes[name] for name in COLORS], 1).astype(float)
        seen = seen * 255 if seen.max() <= 1 else seen
        np.testing.assert_allclose(seen, colors[:, :3], atol=0.51)
    assert abs(read_cloud(tmp_path / f"a.{suffix}", mesh_points=5000).points[:, 2]).max() <= 1.5 + 1e-6


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "pts"])
@pytest.mark.parametrize("ascii", [True, False])
def test_open3d_reads_and_writes(tmp_path: Path, cloud: PointCloud, suffix: str, ascii: bool) -> None:
    try:
        o3d = open3d()
    except Open3DError as error:
        pytest.skip(str(error))
    there = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    there.colors = o3d.utility.Vector3dVector(np.stack([cloud.attributes[c] for c in COLORS], 1) / 255)
    if suffix in ("ply", "pcd"):
        there.normals = o3d.utility.Vector3dVector(np.stack([cloud.attributes[c] for c in NORMALS], 1))
    assert o3d.io.write_point_cloud(str(tmp_path / f"a.{suffix}"), there, write_ascii=ascii, compressed=not ascii)
    names = {"ply": (*NORMALS, *COLORS), "pcd": (*NORMALS, *COLORS), "pts": COLORS, "xyz": ()}[suffix]
    same(read_cloud(tmp_path / f"a.{suffix}"), cloud, names, close=1e-4 if ascii or suffix in ("xyz", "pts") else 1e-6)
    write_cloud(tmp_path / f"b.{suffix}", cloud)
    back = o3d.io.read_point_cloud(str(tmp_path / f"b.{suffix}"))
    np.testing.assert_allclose(np.asarray(back.points), cloud.points, atol=1e-6)
    if suffix != "xyz":
        np.testing.assert_allclose(np.asarray(back.colors) * 255, np.stack([cloud.attributes[c] for c in COLORS], 1))


@pytest.mark.parametrize("kind", [0, 1, 2])  # ascii, binary, binary_compressed
def test_pcl_converts_what_is_written(tmp_path: Path, cloud: PointCloud, kind: int) -> None:
    if shutil.which("pcl_convert_pcd_ascii_binary") is None:
        pytest.skip("PCL's tools are not installed (Debian: pcl-tools)")
    write_cloud(tmp_path / "a.pcd", cloud)
    subprocess.run(
        ["pcl_convert_pcd_ascii_binary", tmp_path / "a.pcd", tmp_path / "b.pcd", str(kind), "12"], check=True,
        capture_output=True,
    )  # fmt: skip
    same(read_cloud(tmp_path / "b.pcd"), cloud, tuple(cloud.attributes), close=1e-6 if kind == 0 else 0)


@pytest.mark.parametrize("suffix", ["ply", "ptx", "xyz", "pts"])
def test_cloudcompare_reads_and_writes(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    """What is written here, read by CloudCompare, written by it as PLY and as text, and read here."""
    if shutil.which("CloudCompare") is None:
        pytest.skip("CloudCompare is not installed (Debian: cloudcompare)")
    write_cloud(tmp_path / f"a.{suffix}", cloud)
    for kind, out in (("PLY", "b.ply"), ("ASC", "b.asc")):
        more = ["-ADD_HEADER", "-PREC", "12"] if kind == "ASC" else ["-PLY_EXPORT_FMT", "BINARY_LE"]
        subprocess.run(
            ["CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", kind, *more, "-O",
             tmp_path / f"a.{suffix}", "-SAVE_CLOUDS", "FILE", tmp_path / out],
            check=True, capture_output=True, env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
        )  # fmt: skip
        back = read_cloud(tmp_path / out)
        same(back, cloud, {"ply": COLORS, "ptx": COLORS, "xyz": (), "pts": COLORS}[suffix], close=1e-5)
        if suffix == "ply":
            same(back, cloud, NORMALS, close=5e-3)  # it keeps normals in 21 bits
