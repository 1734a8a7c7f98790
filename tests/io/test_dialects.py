"""PLY, PCD, NPY, NPZ, .bin and meshes as other programs write them; the cases of `../shared/data/cases/files`."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io import WRITABLE, open_cloud, read_cloud, scans_of, write_cloud
from fmr_cli.vectors import turn_vectors

POINTS = [[1, 2.5, 3], [-4, 5, 600]]
PLY_HEAD = "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
BINARY = np.array(POINTS, "<f4").tobytes()
PCD_HEAD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA {}\n"
TEXT = "1 2.5 3\n-4 5 600\n"

DIALECTS = {
    "cr.ply": (PLY_HEAD.format("ascii") + TEXT).replace("\n", "\r").encode(),
    "crlf.ply": (PLY_HEAD.format("ascii") + TEXT).replace("\n", "\r\n").encode(),
    "cr-binary.ply": PLY_HEAD.format("binary_little_endian").replace("\n", "\r").encode() + BINARY,
    "crlf-binary.ply": PLY_HEAD.format("binary_little_endian").replace("\n", "\r\n").encode() + BINARY,
    "comments.ply": PLY_HEAD.format("ascii").replace("element", "comment made by\n  a program\n\nof two lines\nelement")
    .encode() + TEXT.encode(),
    "upper.ply": PLY_HEAD.format("ASCII").replace("format", "FORMAT").encode() + TEXT.encode(),
    "commas.ply": PLY_HEAD.format("ascii").encode() + b"1,2.5,3\n-4,5,600\n",
    "tabs.ply": PLY_HEAD.format("ascii").encode() + b"1\t2.5\t3\n-4\t5\t600",
    "lower.pcd": PCD_HEAD.format("ascii").lower().encode() + TEXT.encode(),
    "cr.pcd": (PCD_HEAD.format("ascii") + TEXT).replace("\n", "\r").encode(),
    "crlf-binary.pcd": PCD_HEAD.format("binary").replace("\n", "\r\n").encode() + BINARY,
    "columns.pcd": ("COLUMNS x y z\nPOINTS 2\nDATA ascii\n" + TEXT).encode(),
    "no-version.pcd": PCD_HEAD.format("ascii").replace("VERSION .7\n", "").encode() + TEXT.encode(),
    "tabs.pcd": PCD_HEAD.format("ascii").replace(" ", "\t").encode() + TEXT.replace(" ", "\t").encode(),
    "commas.pcd": PCD_HEAD.format("ascii").encode() + TEXT.replace(" ", ",").encode(),
    "count0.pcd": PCD_HEAD.format("binary").replace("x y z", "x y z none").replace("4 4 4", "4 4 4 4")
    .replace("F F F", "F F F F").replace("1 1 1", "1 1 1 0").encode() + BINARY,
}  # fmt: skip


@pytest.mark.parametrize("name", DIALECTS)
def test_every_dialect_holds_the_same_points(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(DIALECTS[name])
    assert read_cloud(tmp_path / name).points.tolist() == POINTS


def scan(columns: int, count: int, seed: int = 0) -> np.ndarray:
    """A turning scanner's rows of float32: x y z, then intensity, ring, time, or colours."""
    rng = np.random.default_rng(seed)
    angle, ring = np.repeat(np.arange(count // 8) / 500, 8), np.tile(np.arange(8), count // 8)
    reach = rng.uniform(3, 40, count // 8).repeat(8)
    xyz = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), reach * (ring - 6) / 40])
    extra = {
        3: [], 4: [rng.random(count)], 5: [rng.integers(0, 256, count), ring],
        6: list(rng.integers(0, 256, (3, count))), 7: [rng.random(count), *rng.integers(0, 256, (3, count))],
        8: [rng.random(count) * 90, ring, rng.random(count), rng.integers(300, 3000, count), angle],
        9: [*np.tile([[0.0], [0.6], [0.8]], count), *rng.integers(0, 256, (3, count))],
        10: [rng.random(count), *np.tile([[0.0], [0.6], [0.8]], count), *rng.integers(0, 256, (3, count))],
    }[columns]  # fmt: skip
    return np.column_stack([xyz, *extra]).astype("<f4")


@pytest.mark.parametrize("columns", range(3, 11))
@pytest.mark.parametrize("count", [840, 16_800, 100_000])
def test_the_layout_of_a_bin_is_told_by_its_values(tmp_path: Path, columns: int, count: int) -> None:
    """Counts for which many widths divide the size."""
    rows = scan(columns, count)
    rows.tofile(tmp_path / "a.bin")
    cloud = read_cloud(tmp_path / "a.bin")
    np.testing.assert_array_equal(cloud.points, rows[:, :3])
    names = {3: [], 4: ["intensity"], 5: ["intensity", "ring"], 6: ["red", "green", "blue"],
             7: ["intensity", "red", "green", "blue"], 9: ["nx", "ny", "nz", "red", "green", "blue"],
             10: ["intensity", "nx", "ny", "nz", "red", "green", "blue"]}  # fmt: skip
    if columns in names:
        assert list(cloud.attributes) == names[columns]
    assert (cloud.layout is None) == (columns == 4)


def test_a_bin_whose_values_do_not_tell_is_refused_with_the_choice(tmp_path: Path) -> None:
    np.random.default_rng(0).normal(size=8400).astype("<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(CloudFileError, match=r"may hold 3 float32, 4 float32.*--bin-columns x,y,z,intensity"):
        read_cloud(tmp_path / "a.bin")
    cloud = read_cloud(tmp_path / "a.bin", bin_columns=("y", "x", "z", "ring"))
    assert cloud.points.shape == (2100, 3)
    assert cloud.points[0, 0] == np.fromfile(tmp_path / "a.bin", "<f4")[1]
    with pytest.raises(CloudFileError, match=r"no multiple of the 44 that a point takes \(x y z a b"):
        read_cloud(tmp_path / "a.bin", bin_columns=tuple("xyzabcdefgh"))
    for columns in (("x", "y", "intensity"), ("x", "y", "z", "t", "t")):
        with pytest.raises(CloudFileError, match="there must be one x, one y and one z, and each other name once"):
            read_cloud(tmp_path / "a.bin", bin_columns=columns)


def test_ncl_t_and_numbers_that_are_no_float32(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-40, 40, (5000, 3)).round(2)
    rows = np.zeros(5000, [("xyz", "<u2", 3), ("i", "u1"), ("ring", "u1")])
    rows["xyz"], rows["i"], rows["ring"] = np.rint((xyz + 100) / 0.005), 7, np.arange(5000) % 32
    rows.tofile(tmp_path / "a.bin")
    cloud = read_cloud(tmp_path / "a.bin")
    assert np.abs(cloud.points - xyz).max() < 1e-9
    assert "NCLT" in cloud.layout
    (tmp_path / "b.bin").write_bytes(rng.bytes(16_000))
    with pytest.raises(CloudFileError, match="holds no float32 coordinates"):
        read_cloud(tmp_path / "b.bin")
    (tmp_path / "c.bin").write_text("1.0 2.0 3.0\n" * 4)
    with pytest.raises(CloudFileError, match="is text: give it the suffix"):
        read_cloud(tmp_path / "c.bin")


@pytest.mark.parametrize(
    ("array", "what"),
    [
        (np.ones((480, 640)), "is it a depth image"),
        (np.ones((48, 17)), "is it a depth image"),
        (np.eye(4), "holds a 4x4 transform and no points"),
        (np.tile(np.eye(4), (30, 1, 1)), "holds poses and no points"),
        (np.tile(np.eye(4)[:3].ravel(), (30, 1)), "holds poses and no points"),
        (np.ones((7, 2)), "points need (N, 3)"),
        (np.ones((2, 2, 2)), "points need (N, 3)"),
        (np.array(["a", "b"]), "points need numbers"),
    ],
)
def test_an_array_that_holds_no_points_is_named_for_what_it_is(tmp_path: Path, array: np.ndarray, what: str) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(CloudFileError, match=re.escape(what)):
        read_cloud(tmp_path / "a.npy")


def test_arrays_in_every_shape(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(600, 3))
    for k, array in enumerate([rows, rows.T, np.asfortranarray(rows), rows.reshape(20, 30, 3), rows.astype(">f4")]):
        np.save(tmp_path / f"{k}.npy", array)
        assert np.abs(read_cloud(tmp_path / f"{k}.npy").points - rows).max() < 1e-6
    records = np.zeros((20, 30), [("X", "f8"), ("Y", "f8"), ("Z", "f8"), ("I", "u2")])
    records["X"], records["Y"], records["Z"] = rows.reshape(20, 30, 3).transpose(2, 0, 1)
    np.save(tmp_path / "r.npy", records)
    assert np.array_equal(read_cloud(tmp_path / "r.npy").points, rows)
    assert read_cloud(tmp_path / "r.npy").attributes["intensity"].dtype == np.uint16


@pytest.mark.parametrize("key", ["points", "xyz", "pc", "vertices", "arr_0", "anything"])
def test_keys_of_an_npz(tmp_path: Path, key: str) -> None:
    rows = np.random.default_rng(0).normal(size=(100, 3))
    more = {} if key == "anything" else {"labels": np.arange(100), "pose": np.eye(4)}
    np.savez(tmp_path / "a.npz", **{key: rows}, **more)
    cloud = read_cloud(tmp_path / "a.npz")
    assert np.array_equal(cloud.points, rows)
    assert cloud.left_out == (("array 'pose'",) if more else ())
    np.savez(tmp_path / "b.npz", x=rows[:, 0], y=rows[:, 1], z=rows[:, 2], t=rows[:, 0])
    assert np.array_equal(read_cloud(tmp_path / "b.npz").points, rows)
    assert list(read_cloud(tmp_path / "b.npz").attributes) == ["t"]


COLOURED = {
    "a.obj": "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nvt 0 0\nf 1 2 3\n",
    "b.obj": "v 0 0 0 255 0 9\nv 1 0 0 255 0 9\nv 0 1 0 255 0 9\nf 1 2 3\n",
    "alpha.obj": "v 0 0 0 255 0 9 0\nv 1 0 0 255 0 9 0\nv 0 1 0 255 0 9 0\nf 1 2 3\n",
    "a.off": "COFF\n3 1 0\n0 0 0 255 0 9 255\n1 0 0 255 0 9 255\n0 1 0 255 0 9 255\n3 0 1 2\n",
    "faces.off": "OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n3 0 1 2 255 0 9\n3 1 2 3 255 0 9\n",
    "shares.off": "COFF\n3 1 0\n0 0 0 1 0 .5 1\n1 0 0 1 0 .5 1\n0 1 0 1 0 .5 1\n3 0 1 2\n",
    "faces.ply": "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\n"
    "property uchar blue\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 9\n",
}


@pytest.mark.parametrize("name", COLOURED)
def test_colours_of_meshes_come_along(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(COLOURED[name])
    cloud = read_cloud(tmp_path / name)
    red, blue = np.unique(cloud.attributes["red"]), np.unique(cloud.attributes["blue"])
    assert (red.tolist(), blue.tolist()) == {
        "a.obj": ([1], [0]), "shares.off": ([1], [0.5]),
    }.get(name, ([255], [9]))  # fmt: skip
    assert cloud.left_out == (("texture coordinates",) if name == "a.obj" else ())
    assert ("alpha" in cloud.attributes) == (name in ("alpha.obj", "a.off", "shares.off"))


def test_what_is_left_out_of_faces_is_said(tmp_path: Path) -> None:
    """Texture coordinates and the like; colours where the vertices have their own."""
    more = "property list uchar float texcoord\nproperty uchar red\n"
    text = COLOURED["faces.ply"].replace("property uchar red\n", more).replace("3 0 1 2 255", "3 0 1 2 1 0.5 255")
    (tmp_path / "a.ply").write_text(text)
    assert read_cloud(tmp_path / "a.ply").left_out == ("property 'texcoord' of the faces",)
    own = "property float z\nproperty uchar red\n"
    text = (
        COLOURED["faces.ply"]
        .replace("property float z\n", own)
        .replace("0 0 0\n1 0 0\n0 1 0", "0 0 0 7\n1 0 0 7\n0 1 0 7")
    )
    (tmp_path / "b.ply").write_text(text)
    cloud = read_cloud(tmp_path / "b.ply")
    assert cloud.left_out == tuple(f"property {name!r} of the faces" for name in ("red", "green", "blue"))
    assert {*cloud.attributes["red"]} == {7}


def turn() -> np.ndarray:
    """A rotation about an oblique axis, a shift, a scale of 2."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = 2 * Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    T[:3, 3] = [5, -6, 7]
    return T


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (("nx", "ny", "nz"), "direction"),
        (("normal_x", "normal_y", "normal_z"), "direction"),
        (("NormalX", "NormalY", "NormalZ"), "direction"),
        (("Normals",), "direction"),
        (("vx", "vy", "vz"), "displacement"),
        (("velocity",), "displacement"),
        (("x_t", "y_t", "z_t"), "displacement"),
        (("x_origin", "y_origin", "z_origin"), "position"),
        (("BeamOriginX", "BeamOriginY", "BeamOriginZ"), "position"),
        (("normals_0", "normals_1", "normals_2"), "direction"),
    ],
)
@pytest.mark.parametrize("suffix", [".las", ".ply", ".npz", ".csv"])
def test_a_vector_of_any_name_turns_through_any_format(
    tmp_path: Path, names: tuple[str, ...], kind: str, suffix: str
) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(50, 3))
    attributes = {names[0]: values} if len(names) == 1 else dict(zip(names, values.T, strict=True))
    write_cloud(tmp_path / f"a{suffix}", PointCloud(rng.normal(size=(50, 3)), attributes))
    T = turn()
    moved = read_cloud(tmp_path / f"a{suffix}").transformed(T)
    R = T[:3, :3] / 2
    expected = {"direction": values @ R.T, "displacement": values @ T[:3, :3].T,
                "position": values @ T[:3, :3].T + T[:3, 3]}[kind]  # fmt: skip
    found = [v for v in moved.attributes.values() if v.dtype.kind == "f" and v.ndim == 2]
    found = found or [np.stack([v for v in moved.attributes.values() if v.dtype == np.float64 and v.any()][-3:], 1)]
    np.testing.assert_allclose(found[0], expected, atol=1e-12)


def test_splats_turn_whole() -> None:
    """The colour that a splat shows along a turned direction is that which it showed along the direction before."""
    from scipy.spatial.transform import Rotation

    from fmr_cli.vectors import basis

    rng = np.random.default_rng(0)
    T = turn()
    R = T[:3, :3] / 2
    for degree in (1, 2, 3):
        count = (degree + 1) ** 2 - 1
        names = [f"f_rest_{k}" for k in range(3 * count)]
        values = {
            n: rng.normal(size=9) for n in [*names, *(f"rot_{k}" for k in range(4)), *(f"scale_{k}" for k in range(3))]
        }
        turned = turn_vectors(values, T)
        d = rng.normal(size=(40, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        before, after = (np.stack([a[n] for n in names[:count]], 1) for a in (values, turned))  # of the first colour
        np.testing.assert_allclose(after @ basis(d @ R.T)[:, :count].T, before @ basis(d)[:, :count].T, atol=1e-9)
        q, p = (np.stack([a[f"rot_{k}"] for k in (1, 2, 3, 0)], 1) for a in (values, turned))
        np.testing.assert_allclose(Rotation.from_quat(p).as_matrix(), R @ Rotation.from_quat(q).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(turned["scale_1"] - values["scale_1"], np.log(2))


CASES = {
    "a.pts": 200, "a.xyz.gz": 200, "comma_semicolon.csv": 200, "comment_pct.txt": 200, "count_first.txt": 200,
    "cr.ply": 200, "ene.csv": 200, "lower.pcd": 200, "missing_cell.csv": 200, "old_columns.pcd": 200,
    "semi_end.txt": 200, "utf16.txt": 200, "T3N.npy": 2000, "normals.npz": 2000, "cc_normals.las": 2000,
    "nuscenes_5floats.pcd.bin": 34_688, "scannet_6floats.bin": 40_684,
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_cases_that_failed(shared_data: Path, name: str) -> None:
    cloud = read_cloud(shared_data / "cases" / "files" / name)
    assert len(cloud) == CASES[name]
    if CASES[name] <= 2000:  # the same scan in all of them
        assert np.abs(cloud.points[0] - [-0.905, 0.098, -1.594]).max() < 1e-3
    if name.startswith("nuscenes"):
        assert set(np.unique(cloud.attributes["ring"])) == set(range(32))
    if name.startswith("scannet"):
        assert {*cloud.attributes} == {"red", "green", "blue"}


def test_an_old_laszip_is_named_as_the_cause(tmp_path: Path) -> None:
    header = laspy.LasHeader(version="1.2", point_format=0)
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(50, header=header))
    las.write(tmp_path / "a.laz")
    data = bytearray((tmp_path / "a.laz").read_bytes())
    place = data.index(b"laszip encoded") - 2 + 54
    assert struct.unpack_from("<H", data, place)[0] == 2
    struct.pack_into("<H", data, place, 1)
    (tmp_path / "a.laz").write_bytes(data)
    with pytest.raises(CloudFileError, match="compressed by a LASzip of before 2011"):
        read_cloud(tmp_path / "a.laz")


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_comments_among_the_points_are_passed_over(tmp_path: Path, kind: str) -> None:
    cloud = PointCloud(np.arange(30.0).reshape(10, 3))
    path = tmp_path / f"a.{kind}"
    head = {
        "ply": "ply\nformat ascii 1.0\nelement vertex 10\n" + "".join(f"property float {c}\n" for c in "xyz")
        + "end_header\n",
        "pcd": "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 10\nHEIGHT 1\nPOINTS 10\n"
        "DATA ascii\n",
    }[kind]  # fmt: skip
    rows = [" ".join(map(str, row)) for row in cloud.points.tolist()]
    rows[7:7] = ["comment in between", "obj_info a"] if kind == "ply" else []
    path.write_text(head + "\n".join(["# first", *rows[:3], "// third", "  # blank", *rows[3:], "# last"]) + "\n")
    found = read_cloud(path)
    np.testing.assert_array_equal(found.points, cloud.points)
    assert found.notes == ()


@pytest.mark.parametrize(
    ("magic", "suffix", "message"),
    [
        (b"ply\nformat ascii 1.0\n", ".pcd", "is a PLY by its first bytes: give it the suffix .ply"),
        (b"LASF\0\0", ".xyz", "is a LAS or LAZ by its first bytes: give it the suffix .las"),
        (b"PK\x03\x04rest", ".las", "is a ZIP archive by its first bytes: unpack it first"),
        (b"\x1f\x8b\x08rest", ".ply", "is packed by gzip by its first bytes: unpack it first"),
        (b"\x93NUMPY\x01", ".bin", "is a NPY by its first bytes: give it the suffix .npy"),
        (b"version https://git-lfs.github.com/spec/v1\n", ".laz", "is a pointer of Git LFS and not the file itself"),
        (b"\r\n<html><body>sign in", ".e57", "is a web page"),
    ],
)
def test_a_file_of_another_kind_is_named_for_what_it_is(
    tmp_path: Path, magic: bytes, suffix: str, message: str
) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(magic + bytes(200))
    for reading in (read_cloud, scans_of) if suffix == ".e57" else (read_cloud,):
        with pytest.raises(CloudFileError, match=re.escape(f"{path}: {message}")):
            reading(path)


def test_numbers_of_a_bin_that_are_whole(tmp_path: Path) -> None:
    """A ring, a packed colour or a clock as uint32; records of 18 bytes, of which two make nine numbers."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(3000, 3)).astype("<f4") * [20, 20, 3]
    color = rng.integers(0, 1 << 24, 3000)
    for values, name in (
        (rng.integers(0, 64, 3000), "ring"), (color, "color"), (color | 255 << 24, "color"),
        (np.arange(3000) * 33, "time"),
    ):  # fmt: skip
        rows = np.zeros(3000, [("xyz", "<f4", 3), ("w", "<u4")])
        rows["xyz"], rows["w"] = points, values
        rows.tofile(tmp_path / "a.bin")
        cloud = read_cloud(tmp_path / "a.bin")
        assert list(cloud.attributes) == [name]
        np.testing.assert_array_equal(cloud.attributes[name], values)
        assert cloud.layout == f"16 bytes a point, by their values x y z {name}:u4"
    rows = np.zeros(3000, [("xyz", "<f4", 3), ("i", "<f4"), ("ring", "<u2")])
    rows["xyz"], rows["i"], rows["ring"] = points, rng.random(3000), rng.integers(0, 32, 3000)
    rows.tofile(tmp_path / "a.bin")
    assert list(read_cloud(tmp_path / "a.bin").attributes) == ["intensity", "ring"]


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_lines_beyond_those_promised_are_counted(tmp_path: Path, kind: str) -> None:
    """In an ascii PLY or PCD; a PLY's other elements are none, nor are blank lines."""
    rows = "".join(f"{n} {n * n % 7} {n % 3}\n" for n in range(1, 41))
    ply = PLY_HEAD.format("ascii").replace("vertex 2", "vertex {}").replace("end_header", "{}end_header")
    pcd = PCD_HEAD.format("ascii").replace("WIDTH 2", "WIDTH {0}").replace("POINTS 2", "POINTS {0}")
    edges = "element edge 2\nproperty int a\n"
    path = tmp_path / f"a.{kind}"
    for promised, left in ((40, 0), (39, 1), (30, 10), (0, 40)):
        path.write_text((ply.format(promised, "") if kind == "ply" else pcd.format(promised)) + rows + "\n\n")
        if promised == 0:
            with pytest.raises(CloudFileError, match="holds no points"):
                read_cloud(path)
            continue
        cloud = read_cloud(path)
        assert len(cloud) == promised
        expected = () if not left else (f"{left} line{'s lie' if left > 1 else ' lies'} beyond the {promised} points",)
        assert [note.split(" that its")[0] for note in cloud.notes] == [*expected]
    path.write_text((ply.format(30, edges) if kind == "ply" else pcd.format(30)) + rows)
    (note,) = read_cloud(path).notes
    assert note.startswith("8 lines" if kind == "ply" else "10 lines")
    for suffix in WRITABLE:
        if suffix == ".e57":
            pytest.importorskip("pye57")
        warnings = write_cloud(tmp_path / f"b{suffix}", open_cloud(path))
        assert f"{path}: {note}" in warnings
        assert len(read_cloud(tmp_path / f"b{suffix}")) == 30
