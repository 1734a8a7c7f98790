"""Each format gives back what was written, and what it cannot hold is said."""

from __future__ import annotations

import struct
from importlib.util import find_spec
from pathlib import Path

import lzf
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.io import WRITABLE, read_cloud, write_cloud
from fmr_cli.io.mesh import fan

# E57 needs pye57, which is an extra
HERE = [suffix for suffix in WRITABLE if suffix != ".e57" or find_spec("pye57")]
FAR = np.array([637_000.0, 4_850_000.0, 120.0])  # a place in UTM


@pytest.fixture
def cloud() -> PointCloud:
    rng = np.random.default_rng(1)
    n = 500
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(
        rng.random((n, 3)) * [90, 60, 20] + FAR,
        {
            "intensity": rng.random(n).astype(np.float32),
            **{color: rng.integers(0, 256, n).astype(np.uint8) for color in ("red", "green", "blue")},
            **{axis: normals[:, i].astype(np.float32) for i, axis in enumerate(("nx", "ny", "nz"))},
            "label": rng.integers(-9, 9, n).astype(np.int32),
            "time": rng.random(n) + 1.7e9,
        },
        crs="EPSG:32633",
        sensor_origin=FAR + 2,
    )


def same(a: PointCloud, b: PointCloud) -> bool:
    """Names, types and values of all attributes are the same bit for bit."""
    return list(a.attributes) == list(b.attributes) and all(
        v.dtype == b.attributes[name].dtype and np.array_equal(v, b.attributes[name])
        for name, v in a.attributes.items()
    )


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz"])
def test_everything_comes_back_bit_for_bit(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    warnings = write_cloud(path, cloud)
    assert ["will round coordinates by up to 0.25" in w for w in warnings] == [True] * (suffix == ".pcd")
    back = read_cloud(path)
    assert np.array_equal(back.points, cloud.points)
    order = sorted(cloud.attributes)
    assert sorted(back.attributes) == order
    assert same(
        PointCloud(cloud.points, {n: cloud.attributes[n] for n in order}),
        PointCloud(back.points, {n: back.attributes[n] for n in order}),
    )
    assert back.crs == cloud.crs
    assert np.array_equal(back.sensor_origin, cloud.sensor_origin)
    assert (back.format, back.path, back.dropped) == (suffix[1:], path, 0)


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv"])
def test_text_keeps_every_value_and_says_what_it_cannot_hold(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    warnings = write_cloud(path, cloud)
    back = read_cloud(path)
    assert np.array_equal(back.points, cloud.points)
    assert list(back.attributes) == list(cloud.attributes)
    assert all(np.array_equal(back.attributes[name], v) for name, v in cloud.attributes.items())
    assert back.attributes["red"].dtype == np.uint8
    assert ["coordinate reference system" in w or "sensor" in w for w in warnings] == [True, True]


def test_npy_holds_coordinates_and_says_that_it_holds_no_more(tmp_path: Path, cloud: PointCloud) -> None:
    warnings = write_cloud(tmp_path / "a.npy", cloud)
    back = read_cloud(tmp_path / "a.npy")
    assert np.array_equal(back.points, cloud.points)
    assert back.attributes == {}
    assert any("intensity, red" in w and ".npz" in w for w in warnings)
    plain = PointCloud(cloud.points, {"intensity": cloud.attributes["intensity"]})
    assert write_cloud(tmp_path / "b.npy", plain) == []
    assert np.array_equal(read_cloud(tmp_path / "b.npy").attributes["intensity"], plain.attributes["intensity"])


def test_kitti_bin_is_exact_for_float32_and_warns_otherwise(tmp_path: Path, cloud: PointCloud) -> None:
    near = PointCloud(
        (cloud.points - FAR).astype(np.float32), {"intensity": cloud.attributes["intensity"]}, sensor_origin=np.zeros(3)
    )
    assert write_cloud(tmp_path / "a.bin", near) == []
    back = read_cloud(tmp_path / "a.bin")
    assert np.array_equal(back.points, near.points)
    assert same(back, near)
    assert np.array_equal(back.sensor_origin, np.zeros(3))
    warnings = write_cloud(tmp_path / "b.bin", cloud)
    for said in ("rounded by up to 0.2", "red, green, blue", "sensor", "coordinate reference system"):
        assert any(said in w for w in warnings), said


@pytest.mark.parametrize("suffix", HERE)
def test_only_the_coordinates_are_read_on_request(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    write_cloud(tmp_path / f"a{suffix}", cloud)
    bare = read_cloud(tmp_path / f"a{suffix}", attributes=False)
    assert bare.attributes == {}
    assert np.array_equal(bare.points, read_cloud(tmp_path / f"a{suffix}").points)


NORMALS, COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")
HOLD_CRS = (".ply", ".pcd", ".las", ".laz", ".npz", ".e57")


def kept(suffix: str, names: list[str]) -> list[str]:
    """Which of a cloud's attributes a format holds, as docs/formats.md says."""
    if suffix == ".bin":
        return [name for name in names if name == "intensity"]
    if suffix in (".pts", ".ptx"):
        return [name for name in names if name in ("intensity", *COLORS)]
    if suffix == ".npy":
        return names if names in (["intensity"], ["intensity", *COLORS]) else []
    return names


@pytest.mark.parametrize("source", HERE)
@pytest.mark.parametrize("target", HERE)
def test_any_format_to_any_format(tmp_path: Path, cloud: PointCloud, source: str, target: str) -> None:
    """Coordinates, attributes, vectors under a turn, and the coordinate system, from each format to each."""
    write_cloud(tmp_path / f"a{source}", cloud)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.02, -0.03, 0.4]).as_matrix()
    T[:3, 3] = FAR - T[:3, :3] @ FAR + [3, 4, 5]
    first = read_cloud(tmp_path / f"a{source}").transformed(T)
    write_cloud(tmp_path / f"b{target}", first)
    second = read_cloud(tmp_path / f"b{target}")
    tolerance = {".bin": 0.26, ".las": 5.1e-7, ".laz": 5.1e-7}  # float32 in UTM; half a scale step
    assert np.abs(first.points - second.points).max() <= tolerance.get(target, 2e-9)  # of PTX, in its scan's frame
    moved = transform_points(T, cloud.points)
    assert np.abs(second.points - moved).max() <= tolerance.get(source, 0) + tolerance.get(target, 0) + 2e-9
    expected = cloud.transformed(T).attributes
    for name in kept(target, kept(source, list(cloud.attributes))):
        close = 1e-6 if name in NORMALS else 0
        values = second.attributes[name]
        if name in COLORS and values.max() > 255:  # LAS: 8 bits as 16
            values = values / 257
        np.testing.assert_allclose(values, expected[name], rtol=0, atol=close, err_msg=name)
    both = source in HOLD_CRS and target in HOLD_CRS
    assert second.crs == (cloud.crs if both else None)


PLY_ROWS = [(1.5, -2.0, 3.25, 7, 200), (4.0, 5.0, 6.0, -8, 0), (0.0, 0.5, 1.0, 9, 255)]
PLY_HEADER = """ply
format {} 1.0
comment made by hand
obj_info nothing
element camera 1
property float f
property list uchar int ids
element vertex 3
property float x
property double y
property float z
property list uchar ushort neighbours
property short label
property uchar red
element edge 1
property int a
end_header
"""


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_with_lists_and_other_elements(tmp_path: Path, kind: str) -> None:
    order = ">" if "big" in kind else "<"
    if kind == "ascii":
        body = b"0.5 2 10 11\n"
        body += "".join(f"{x} {y} {z} {k} {'7 ' * k}{n} {r}\n" for k, (x, y, z, n, r) in enumerate(PLY_ROWS)).encode()
        body += b"5\n"
    else:
        body = struct.pack(f"{order}fB2i", 0.5, 2, 10, 11)
        for k, (x, y, z, n, r) in enumerate(PLY_ROWS):
            body += struct.pack(f"{order}fdfB{k}HhB", x, y, z, k, *[7] * k, n, r)
        body += struct.pack(f"{order}i", 5)
    (tmp_path / "a.ply").write_bytes(PLY_HEADER.format(kind).encode() + body)
    cloud = read_cloud(tmp_path / "a.ply")
    assert cloud.points.tolist() == [[1.5, -2.0, 3.25], [4.0, 5.0, 6.0], [0.0, 0.5, 1.0]]
    assert cloud.attributes["label"].tolist() == [7, -8, 9]
    assert cloud.attributes["label"].dtype == np.int16
    assert cloud.attributes["red"].tolist() == [200, 0, 255]
    assert cloud.left_out == ("list property 'neighbours'", "element 'camera'", "element 'edge'")


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("color", ["F", "U"])
def test_pcd_encodings_and_packed_colours(tmp_path: Path, kind: str, color: str) -> None:
    bits = np.array([0x0A0B0C, 0x000001, 0x40FF00], "<u4")
    fields = [("x", "<f4"), ("y", "<f8"), ("_", "<u1", (3,)), ("z", "<f4"), ("rgb", "<u4"), ("hist", "<i2", (2,))]
    rows = np.zeros(3, fields)
    rows["x"], rows["y"], rows["z"], rows["rgb"] = [1.5, 2.5, 3.5], [1e6 + 0.1, 0, -1], [7, 8, 9], bits
    rows["hist"] = [[1, 2], [3, 4], [5, 6]]
    if kind == "ascii":
        packed = [repr(float(v)) for v in bits.view("<f4")] if color == "F" else [str(v) for v in bits]
        lines = [
            f"{r['x']} {r['y']!r} 0 0 0 {r['z']} {packed[k]} {r['hist'][0]} {r['hist'][1]}".replace("np.float64(", "")
            for k, r in enumerate(rows)
        ]
        body = "\n\n".join(lines).replace(")", "").encode()
    elif kind == "binary":
        body = rows.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
        packed_data = lzf.compress(plain)
        body = struct.pack("<II", len(packed_data), len(plain)) + packed_data
    header = (
        "# .PCD v.7\nVERSION .7\nFIELDS x y _ z rgb hist\nSIZE 4 8 1 4 4 2\nTYPE F F U F " + color + " I\n"
        f"COUNT 1 1 3 1 1 2\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 3\nDATA {kind}\n"
    )
    (tmp_path / "a.pcd").write_bytes(header.encode() + body)
    cloud = read_cloud(tmp_path / "a.pcd")
    assert cloud.points.tolist() == [[1.5, 1e6 + 0.1, 7], [2.5, 0, 8], [3.5, -1, 9]]
    assert [cloud.attributes[c].tolist() for c in ("red", "green", "blue")] == [[10, 0, 64], [11, 0, 255], [12, 1, 0]]
    assert cloud.attributes["hist"].tolist() == [[1, 2], [3, 4], [5, 6]]
    assert cloud.sensor_origin.tolist() == [1, 2, 3]
    write_cloud(tmp_path / "b.pcd", cloud)
    assert b"\nFIELDS x y z hist rgb x_rest" in (tmp_path / "b.pcd").read_bytes()
    assert np.array_equal(read_cloud(tmp_path / "b.pcd").points, cloud.points)
    assert same(read_cloud(tmp_path / "b.pcd"), PointCloud(cloud.points, {
        name: cloud.attributes[name] for name in ("hist", "red", "green", "blue")
    }))  # fmt: skip


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("1 2 3\n4 5 6\n", []),
        ("\n# a comment\n1;2;3;0.5\n\n4;5;6;0.25\n", ["intensity"]),
        ("1,2,3,10,20,30\n4,5,6,255,0,1\n", ["red", "green", "blue"]),
        ("1 2 3 0 0 1\n4 5 6 0.6 0 0.8\n", ["nx", "ny", "nz"]),
        ("1\t2\t3\t0.5\t1\t2\t3\n4\t5\t6\t0.5\t1\t2\t255\n", ["intensity", "red", "green", "blue"]),
        ("1 2 3 0.5 7.5\n4 5 6 0.5 8.5", ["column_4", "column_5"]),
        ("//X Y Z R G B time\n1 2 3 1 2 3 0.5\n4 5 6 1 2 3 0.75\n", ["red", "green", "blue", "time"]),
        ('\ufeff"label","x","y","z"\r\n7,1,2,3\r\n8,4,5,6\r\n', ["label"]),
    ],
)
def test_text_with_and_without_names(tmp_path: Path, text: str, names: list[str]) -> None:
    (tmp_path / "a.txt").write_bytes(text.encode())
    cloud = read_cloud(tmp_path / "a.txt")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert list(cloud.attributes) == names


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [np.nan, 1, 1], [1, np.inf, 1], [2, 2, 2], [1, 1, -np.inf]], dtype=np.float32)
    np.hstack([points, np.arange(5, dtype=np.float32)[:, None]]).tofile(tmp_path / "a.bin")
    cloud = read_cloud(tmp_path / "a.bin")
    assert cloud.points.tolist() == [[0, 0, 0], [2, 2, 2]]
    assert cloud.attributes["intensity"].tolist() == [0, 3]
    assert cloud.dropped == 3


CUBE = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def mesh_text(suffix: str) -> bytes:
    vertices = "".join(f"{x} {y} {z}\n" for x, y, z in CUBE)
    if suffix == ".off":
        return ("OFF8 6 0\n" + vertices + "".join(f"4 {' '.join(map(str, q))} 255 0 0\n" for q in QUADS)).encode()
    if suffix == ".obj":
        lines = [f"v {x} {y} {z}\n" for x, y, z in CUBE] + ["vn 0 0 1\n"]
        return "".join(lines + [f"f {' '.join(f'{i - 8}//1' for i in q)}\n" for q in QUADS]).encode()
    if suffix == ".stl":
        corners = [[CUBE[q[0]], CUBE[q[k]], CUBE[q[k + 1]]] for q in QUADS for k in (1, 2)]
        triangles = [struct.pack("<12fH", 0, 0, 0, *np.ravel(c), 0) for c in corners]
        return b"solid, or not".ljust(80) + struct.pack("<I", 12) + b"".join(triangles)
    header = "element vertex 8\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    header += "element face 6\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{x} {y} {z} {255 * x}\n" for x, y, z in CUBE) + "".join(
        f"4 {' '.join(map(str, q))}\n" for q in QUADS
    )
    return f"ply\nformat ascii 1.0\n{header}{rows}".encode()


@pytest.mark.parametrize("suffix", [".off", ".obj", ".stl", ".ply"])
def test_the_surface_of_a_mesh_is_sampled_evenly_and_repeatably(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cube{suffix}"
    path.write_bytes(mesh_text(suffix))
    cloud = read_cloud(path, mesh_points=6000, seed=3)
    assert len(cloud) == 6000
    on_side = [(cloud.points[:, axis] == side).mean() for axis in range(3) for side in (0, 1)]
    assert np.abs(np.array(on_side) - 1 / 6).max() < 0.02
    assert cloud.mesh is not None
    assert cloud.mesh[1] == 12
    assert cloud.format == "mesh"
    assert np.array_equal(read_cloud(path, mesh_points=6000, seed=3).points, cloud.points)
    assert not np.array_equal(read_cloud(path, mesh_points=6000, seed=4).points, cloud.points)
    assert len(read_cloud(path)) == 10_000
    assert np.array_equal(np.unique(read_cloud(path, mesh_points=0).points, axis=0), CUBE)
    if suffix == ".ply":
        assert set(cloud.attributes["red"][cloud.points[:, 0] == 1]) == {255}
        assert set(cloud.attributes["red"][cloud.points[:, 0] == 0]) == {0}


def test_polygons_of_any_number_of_corners_become_fans() -> None:
    """All polygons' first triangles, then their second ones, smaller polygons first; what a face has goes along."""
    faces = [(0, 1, 2, 3), (4, 5, 6), (7, 8), (9, 8, 7, 6)]
    triangles, of_faces = fan(faces, {"red": np.array([1, 2, 3, 4])})
    assert triangles.tolist() == [[4, 5, 6], [0, 1, 2], [9, 8, 7], [0, 2, 3], [9, 7, 6]]
    assert of_faces["red"].tolist() == [2, 1, 4, 1, 4]
    assert len(fan([range(300_000)], {})[0]) == 299_998
    assert fan([(0, 1)], {"red": np.array([1])})[0].shape == (0, 3)


def test_a_ply_with_an_empty_face_element_is_a_cloud(tmp_path: Path) -> None:
    text = mesh_text(".ply").decode().replace("element face 6", "element face 0")
    (tmp_path / "a.ply").write_text(text)
    assert read_cloud(tmp_path / "a.ply").points.tolist() == CUBE


def test_a_pcd_of_float32_is_written_as_one(tmp_path: Path) -> None:
    cloud = PointCloud(np.array([[0.1, 2, 3], [1, 2, 80]], np.float32))
    assert write_cloud(tmp_path / "a.pcd", cloud) == []
    assert b"FIELDS x y z\nSIZE 4 4 4\n" in (tmp_path / "a.pcd").read_bytes()
    assert np.array_equal(read_cloud(tmp_path / "a.pcd").points, cloud.points)
    far = PointCloud(cloud.points * 1e300)
    write_cloud(tmp_path / "b.pcd", far)
    assert np.array_equal(read_cloud(tmp_path / "b.pcd").points, far.points)


def test_an_attribute_of_several_numbers_is_split_with_a_warning(tmp_path: Path) -> None:
    cloud = PointCloud(np.zeros((2, 3)), {"a b": np.array([[1, 2], [3, 4]]), "wide": np.array([2**60 + 1, 5])})
    warnings = write_cloud(tmp_path / "a.ply", cloud)
    assert warnings[0] == "attribute 'a b' is written as a_b_0, a_b_1"
    assert "wide is rounded" in warnings[1]
    assert read_cloud(tmp_path / "a.ply").attributes["a_b_1"].tolist() == [2, 4]
    assert write_cloud(tmp_path / "a.pcd", cloud) == ["attribute 'a b' is written as a_b"]
    assert read_cloud(tmp_path / "a.pcd").attributes["wide"].tolist() == [2**60 + 1, 5]
