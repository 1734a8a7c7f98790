"""Small valid files of every format and dialect that fmr reads, all with the same 60 points, made by this code alone.

For the tests of formats (`docs/formats.md` has a line for each ``row``), and as what the fuzzer starts from.
"""

from __future__ import annotations

import gzip
import io
import struct
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import laspy
import lzf
import numpy as np

from benchmarks.bag_files import OUSTER, write_bag
from benchmarks.bag_files import records as bag_records
from benchmarks.copc_file import write_copc
from fmr_cli.cloud import PointCloud
from fmr_cli.io import write_cloud

COUNT = 60


def points() -> np.ndarray:
    """(60, 3) float64, exact in float32 and to a thousandth."""
    rng = np.random.default_rng(7)
    return rng.integers(-40_000, 40_000, (COUNT, 3)) / 1024 * np.array([1, 1, 0.25])


@dataclass(frozen=True)
class Example:
    """A file. row: its line in docs/formats.md. attributes: what is read besides x y z. left_out: what is not.

    close: how far off its coordinates may be read.
    """

    row: str
    name: str
    data: bytes
    attributes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    close: float = 1e-9


P = points()
RGB = np.stack([np.arange(COUNT) * 4, 255 - np.arange(COUNT), np.full(COUNT, 7)], 1).astype(np.uint8)
I = np.arange(COUNT) * 3 + 300  # noqa: E741
N = np.tile([0.0, 0.6, 0.8], (COUNT, 1))
COLORS, NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")


def lines(sep: str = " ", *more: np.ndarray, decimal: str = ".", end: str = "", quote: str = "") -> str:
    """A line a point; integers of ``more`` as they are."""
    columns = [[f"{value:.15g}".replace(".", decimal) for value in column] for column in [*P.T, *more]]
    return "".join(sep.join(f"{quote}{c}{quote}" for c in row) + end + "\n" for row in zip(*columns, strict=True))


def text_examples() -> list[Example]:
    plain, csv = lines(), lines(",")
    many = (*RGB.T,)
    table = [
        ("text: blanks or tabs", "blanks.xyz", plain),
        ("text: blanks or tabs", "tabs.txt", lines("\t")),
        ("text: blanks or tabs", "mixed.asc", lines(" \t ")),
        ("text: commas, semicolons, bars, colons", "commas.csv", csv),
        ("text: commas, semicolons, bars, colons", "semicolons.txt", lines(";")),
        ("text: commas, semicolons, bars, colons", "bars.txt", lines("|")),
        ("text: commas, semicolons, bars, colons", "colons.txt", "x:y:z\n" + lines(":")),
        ("text: decimal comma", "decimal.csv", lines(";", decimal=",")),
        ("text: decimal comma", "decimal_tabs.txt", lines("\t", decimal=",")),
        ("text: decimal comma", "decimal_blanks.txt", lines(" ", decimal=",")),
        ("text: separator at the end of a line", "trailing.txt", lines(";", end=";")),
        ("text: quotes", "quotes.csv", '"x","y","z"\n' + lines(",", quote='"')),
        ("text: names in the first line", "names.csv", "x,y,z\n" + csv),
        ("text: names in the first line", "units.csv", '"X [m]","Y [m]","Z [m]"\n' + csv),
        ("text: names in the first line", "enh.csv", "Easting,Northing,Elevation\n" + csv),
        ("text: names in the first line", "german.csv", "Rechtswert;Hochwert;H\u00f6he\n" + lines(";", decimal=",")),
        ("text: names in the first line", "report.txt", "Project: a\nDate: 2020\nX Y Z\n" + plain),
        ("text: a count in the first line", "count.xyz", f"{COUNT}\n" + plain),
        ("text: comments by # % // ; ! ' REM -- *", "comments.txt", "% a\n# b\n// c\n; d\n" + plain),
        ("text: comments by # % // ; ! ' REM -- *", "basic.txt", "REM a\n' b\n! c\n-- d\n* e\n" + plain),
        ("text: Fortran exponents", "fortran.txt", "".join(
            " ".join(f"{v:.12E}".replace("E", "D") for v in p) + "\n" for p in P
        )),
        ("text: line ends LF, CR LF, CR", "crlf.csv", csv.replace("\n", "\r\n")),
        ("text: line ends LF, CR LF, CR", "cr.txt", plain.replace("\n", "\r")),
    ]  # fmt: skip
    found = [Example(row, name, text.encode()) for row, name, text in table]
    for encoding in ("utf-8-sig", "utf-16", "utf-16-be", "utf-32"):
        found.append(Example("text: UTF-8 with BOM, UTF-16, UTF-32", f"{encoding}.txt", plain.encode(encoding)))
    found.append(
        Example("text: Latin-1", "latin.csv", ("Rechtswert;Hochwert;H\u00f6he\n" + lines(";")).encode("cp1252"))
    )
    colored = "//X Y Z R G B\n" + lines(" ", *many)
    found += [
        Example("text: names in a comment", "cloudcompare.txt", colored.encode(), COLORS),
        Example("text: colours, normals, intensity without names", "bare.txt", lines(" ", *many).encode(), COLORS),
        Example("text: colours, normals, intensity without names", "normals.txt", lines(" ", *N.T).encode(), NORMALS),
        Example(
            "text: colours, normals, intensity without names", "all.txt", lines(" ", I, *many, *N.T).encode(),
            ("intensity", *COLORS, *NORMALS),
        ),
        Example("text: columns of words", "words.csv", ("id,x,y,z,label\n" + "".join(
            f"p{k}," + line + ",tree\n" for k, line in enumerate(csv.splitlines())
        )).encode(), (), ("text column 'id'", "text column 'label'")),
        Example("text: the points' numbers first", "numbers.txt", "".join(
            f"{k + 1} {line}\n" for k, line in enumerate(plain.splitlines())
        ).encode(), (), ("column 1, the points' numbers",)),
        Example("text: gzip", "packed.xyz.gz", gzip.compress(plain.encode(), mtime=0)),
        Example("text: gzip", "packed.csv.gz", gzip.compress(csv.encode(), mtime=0)),
        Example("PTS", "a.pts", (f"{COUNT}\n" + lines(" ", I, *many)).encode(), ("intensity", *COLORS)),
        Example("PTS", "two.pts", ("30\n" + "".join(lines(" ", I).splitlines(True)[:30]) + "30\n"
                                   + "".join(lines(" ", I).splitlines(True)[30:])).encode(), ("intensity",)),
    ]  # fmt: skip
    eye = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    rows = lines(" ", np.full(COUNT, 0.5)).splitlines(keepends=True)
    ptx = f"6\n10\n{eye}" + "".join(rows)
    two = f"3\n10\n{eye}{''.join(rows[:30])}5\n6\n{eye}{''.join(rows[30:])}"
    found += [
        Example("PTX: one scan or several", "one.ptx", ptx.encode(), ("intensity",)),
        Example("PTX: one scan or several", "two.ptx", two.encode(), ("intensity", "scan")),
    ]
    return found


def ply(form: str, properties: list[str], body: bytes, before: str = "", after: str = "") -> bytes:
    head = f"ply\nformat {form} 1.0\n{before}element vertex {COUNT}\n"
    head += "".join(f"property {p}\n" for p in properties) + after + "end_header\n"
    return head.encode() + body


def records(order: str, *columns: tuple[str, np.ndarray]) -> bytes:
    rows = np.zeros(COUNT, [(f"c{k}", order + kind) for k, (kind, _) in enumerate(columns)])
    for k, (_, values) in enumerate(columns):
        rows[f"c{k}"] = values
    return rows.tobytes()


def ply_examples() -> list[Example]:
    xyz = [f"float {axis}" for axis in "xyz"]
    floats = [("f4", column) for column in P.T]
    text = lines().encode()
    little, big = records("<", *floats), records(">", *floats)
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    harmonics = [f"f_rest_{k}" for k in range(9)]
    splat = [*NORMALS, *(f"f_dc_{k}" for k in range(3)), *harmonics, "opacity", *(f"scale_{k}" for k in range(3)),
             *(f"rot_{k}" for k in range(4))]  # fmt: skip
    rng = np.random.default_rng(0)
    return [
        Example("PLY: ascii", "ascii.ply", ply("ascii", xyz, text)),
        Example("PLY: ascii", "doubles.ply", ply("ascii", [f"double {axis}" for axis in "xyz"], text)),
        Example("PLY: ascii", "commas.ply", ply("ascii", xyz, lines(",").encode())),
        Example("PLY: ascii", "comma_blank.ply", ply("ascii", xyz, lines(", ").encode())),
        Example("PLY: ascii", "semicolons.ply", ply("ascii", xyz, lines(";").encode())),
        Example("PLY: ascii", "capitals.ply", ply("ascii", xyz, b"").upper().replace(b" X", b" x") + text),
        Example("PLY: ascii", "points.ply", ply("ascii", xyz, text).replace(b"element vertex", b"element points")),
        Example("PLY: binary, both byte orders", "little.ply", ply("binary_little_endian", xyz, little)),
        Example("PLY: binary, both byte orders", "big.ply", ply("binary_big_endian", xyz, big)),
        Example("PLY: line ends LF, CR LF, CR", "cr.ply", ply("ascii", xyz, text).replace(b"\n", b"\r")),
        Example("PLY: line ends LF, CR LF, CR", "crlf.ply", ply("ascii", xyz, text).replace(b"\n", b"\r\n")),
        Example("PLY: comments of several lines", "comments.ply",
                ply("ascii", xyz, text, "comment made by\n a program\nobj_info x\n")),
        Example("PLY, PCD: comments among the points of ascii", "among.ply",
                ply("ascii", xyz, text.replace(b"\n", b"\ncomment x\n# y\n", 2))),
        Example("PLY: colours, normals, any property", "colors.ply",
                ply("binary_little_endian", [*xyz, *(f"uchar {c}" for c in COLORS), "float quality"],
                    records("<", *floats, *(("u1", c) for c in RGB.T), ("f4", I))), (*COLORS, "quality")),
        Example("PLY: other elements and lists", "others.ply",
                ply("binary_little_endian", [*xyz, "list uchar int near"], b"".join(
                    little[12 * k : 12 * k + 12] + struct.pack("<B2i", 2, 1, 2) for k in range(COUNT)
                )), (), ("list property 'near'",)),
        Example("PLY: other elements and lists", "camera.ply",
                ply("ascii", xyz, b"1 2 3\n" + text, "element camera 1\nproperty float a\nproperty float b\n"
                    "property float c\n"), (), ("element 'camera'",)),
        Example("PLY: Gaussian splats", "splats.ply",
                ply("binary_little_endian", [*xyz, *(f"float {name}" for name in splat)],
                    records("<", *floats, *(("f4", rng.normal(size=COUNT)) for _ in splat))), tuple(splat)),
        Example("PLY, OFF, OBJ, STL with faces", "mesh.ply", ply("ascii", xyz, text + b"3 0 1 2\n", after=faces)),
        Example("PLY, OFF, OBJ, STL with faces", "faces_first.ply", ply("ascii", xyz, b"3 0 1 2\n" + text, faces)),
    ]  # fmt: skip


def pcd(names: str, sizes: str, kinds: str, data: str, body: bytes, counts: str = "") -> bytes:
    counts = counts or " ".join("1" for _ in names.split())
    return (
        f"# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS {names}\nSIZE {sizes}\nTYPE {kinds}\n"
        f"COUNT {counts}\nWIDTH {COUNT}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\nDATA {data}\n"
    ).encode() + body


def pcd_examples() -> list[Example]:
    xyz, text, sizes, kinds = "x y z", lines().encode(), "4 4 4", "F F F"
    floats = [("f4", column) for column in P.T]
    body = records("<", *floats)
    packed = (RGB[:, 0].astype("<u4") << 16) | (RGB[:, 1].astype("<u4") << 8) | RGB[:, 2]
    columns = np.zeros((4, COUNT), "<f4")
    columns[:3] = P.T
    squeezed = lzf.compress(columns.tobytes())
    compressed = struct.pack("<II", len(squeezed), columns.nbytes) + squeezed
    return [
        Example("PCD: ascii", "ascii.pcd", pcd(xyz, sizes, kinds, "ascii", text)),
        Example("PCD: ascii", "commas.pcd", pcd(xyz, sizes, kinds, "ascii", lines(",").encode())),
        Example("PCD: ascii", "comma_blank.pcd", pcd(xyz, sizes, kinds, "ascii", lines(", ").encode())),
        Example("PLY, PCD: comments among the points of ascii", "among.pcd",
                pcd(xyz, sizes, kinds, "ascii", b"# x\n" + text.replace(b"\n", b"\n# y\n", 2))),
        Example("PCD: binary", "binary.pcd", pcd(xyz, sizes, kinds, "binary", body)),
        Example("PCD: binary_compressed", "packed.pcd",
                pcd("x y z i", "4 4 4 4", "F F F F", "binary_compressed", compressed), ("intensity",)),
        Example("PCD: old headers, small letters", "old.pcd",
                f"COLUMNS x y z\nPOINTS {COUNT}\nDATA ascii\n".encode() + text),
        Example("PCD: old headers, small letters", "lower.pcd",
                pcd(xyz, sizes, kinds, "ascii", b"").lower() + text),
        Example("PCD: packed colours", "rgb.pcd",
                pcd("x y z rgb", "4 4 4 4", "F F F U", "binary", records("<", *floats, ("u4", packed))), COLORS),
        Example("PCD: fields of several values, of none, padding", "count.pcd",
                pcd("x y z _ normal_x normal_y normal_z none", "4 4 4 1 4 4 4 4", "F F F U F F F F", "binary",
                    records("<", *floats, ("u4", np.zeros(COUNT)), *(("f4", c) for c in N.T)), "1 1 1 4 1 1 1 0"),
                NORMALS),
    ]  # fmt: skip


def numpy_examples() -> list[Example]:
    def npy(array: np.ndarray) -> bytes:
        file = io.BytesIO()
        np.save(file, array)
        return file.getvalue()

    def npz(**arrays: np.ndarray) -> bytes:
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), npy(array))
        return file.getvalue()

    named = np.zeros(COUNT, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("i", "u2")])
    named["x"], named["y"], named["z"], named["i"] = *P.T, I
    return [
        Example("NPY: (N, 3), (3, N), images, any type", "rows.npy", npy(P)),
        Example("NPY: (N, 3), (3, N), images, any type", "columns.npy", npy(P.T)),
        Example("NPY: (N, 3), (3, N), images, any type", "image.npy", npy(P.reshape(6, 10, 3))),
        Example("NPY: (N, 3), (3, N), images, any type", "batch.npy", npy(P.T[None])),
        Example("NPY: (N, 3), (3, N), images, any type", "big.npy", npy(P.astype(">f4"))),
        Example("NPY: colours, normals, intensity behind", "wide.npy", npy(np.hstack([P, RGB])), COLORS),
        Example("NPY: records", "records.npy", npy(named), ("intensity",)),
        Example("NPZ: points and attributes", "own.npz", npz(points=P, intensity=I), ("intensity",)),
        Example("NPZ: points and attributes", "keys.npz", npz(xyz=P.astype("f4"), rgb=RGB, normals=N, pose=np.eye(4)),
                (*COLORS, *NORMALS), ("array 'pose'",)),
        Example("NPZ: points and attributes", "capitals.npz", npz(XYZ=P, RGB=RGB), COLORS),
        Example("NPZ: points and attributes", "axes.npz", npz(x=P[:, 0], y=P[:, 1], z=P[:, 2], t=I), ("t",)),
    ]  # fmt: skip


def scanned(count: int = 4000) -> np.ndarray:
    """(n, 3) as a turning scanner sees them: enough points for the layout of a .bin to show."""
    rng = np.random.default_rng(3)
    reach, angle, ring = rng.uniform(2, 50, count), np.arange(count) / count * 2 * np.pi, np.arange(count) % 32
    return np.column_stack([reach * np.cos(angle), reach * np.sin(angle), reach * (ring - 20) / 60]).astype("<f4")


def bin_examples() -> list[Example]:
    xyz = scanned()
    n = len(xyz)
    rng = np.random.default_rng(4)
    ring, time, share = np.arange(n) % 32, np.arange(n) / n * 0.1, rng.random(n)
    colors = rng.integers(0, 256, (n, 3))

    def packed(*columns: tuple[str, np.ndarray]) -> bytes:
        rows = np.zeros(n, [("xyz", "<f4", 3), *((f"c{k}", "<" + kind) for k, (kind, _) in enumerate(columns))])
        rows["xyz"] = xyz
        for k, (_, values) in enumerate(columns):
            rows[f"c{k}"] = values
        return rows.tobytes()

    nclt = np.zeros(n, [("xyz", "<u2", 3), ("i", "u1"), ("ring", "u1")])
    nclt["xyz"], nclt["ring"] = np.rint((xyz.astype(float) + 100) / 0.005), ring
    four, rest = ".bin: 4 float32 (KITTI)", ".bin: 3, or 5 to 10 float32"
    return [
        Example(four, "kitti.bin", packed(("f4", share)), ("intensity",)),
        Example(rest, "three.bin", packed()),
        Example(rest, "nuscenes.bin", packed(("f4", colors[:, 0]), ("f4", ring)), ("intensity", "ring")),
        Example(rest, "six.bin", packed(*(("f4", c) for c in colors.T)), COLORS),
        Example(rest, "seven.bin", packed(*(("f4", c) for c in colors.T), ("f4", share)), (*COLORS, "intensity")),
        Example(rest, "ten.bin", packed(("f4", share), *(("f4", c) for c in np.tile([[0.0], [0.6], [0.8]], n)),
                                        *(("f4", c) for c in colors.T)), ("intensity", *NORMALS, *COLORS)),
        Example(rest, "time.bin", packed(("f4", share), ("f4", ring), ("f4", time)), ("intensity", "ring", "time")),
        Example(".bin: with uint32, uint16, float64", "whole.bin", packed(("f4", share), ("u4", ring)),
                ("intensity", "ring")),
        Example(".bin: with uint32, uint16, float64", "color.bin",
                packed(("u4", colors @ [1 << 16, 1 << 8, 1] + (255 << 24))), ("color",)),
        Example(".bin: with uint32, uint16, float64", "velodyne.bin", packed(("f4", share), ("u2", ring), ("f4", time)),
                ("intensity", "ring", "time")),
        Example(".bin: with uint32, uint16, float64", "doubles.bin", np.hstack([xyz, share[:, None]]).tobytes(),
                ("intensity",)),
        Example(".bin: NCLT's 8 bytes", "nclt.bin", nclt.tobytes(), ("intensity", "ring"), close=0.0026),
    ]  # fmt: skip


def mesh_examples() -> list[Example]:
    row = "PLY, OFF, OBJ, STL with faces"
    off = f"OFF\n{COUNT} 1 0\n{lines()}3 0 1 2\n"
    obj = "".join(f"v {line}\n" for line in lines().splitlines())
    colored = "".join(f"v {line} 0.5 0.25 1\n" for line in lines().splitlines())
    corner = "".join(f"vertex {line}\n" for line in lines().splitlines())
    stl = f"solid a\n{corner}endsolid a\n"
    binary = bytes(80) + struct.pack("<I", 20)
    for k in range(20):
        binary += struct.pack("<12fH", 0, 0, 1, *P[3 * k : 3 * k + 3].reshape(-1), 0)
    return [
        Example(row, "mesh.off", off.encode()),
        Example(row, "mesh.obj", (obj + "f 1 2 3\n").encode()),
        Example(row, "textured.obj", (colored + "vt 0 0\nf 1/1 2/1 3/1\n").encode(), COLORS, ("texture coordinates",)),
        Example(row, "text.stl", stl.encode()),
        Example(row, "binary.stl", binary),
        Example("OBJ, OFF without faces", "points.obj", obj.encode()),
        Example("OBJ, OFF without faces", "points.off", f"OFF\n{COUNT} 0 0\n{lines()}".encode()),
    ]


def las_examples() -> list[Example]:
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for version, kind in (("1.2", 0), ("1.2", 3), ("1.4", 6), ("1.4", 7)):
            for suffix in (".las", ".laz"):
                header = laspy.LasHeader(version=version, point_format=kind)
                header.scales, header.offsets = np.full(3, 1 / 4096), np.zeros(3)
                las = laspy.LasData(header)
                las.x, las.y, las.z, las.intensity = *P.T, I
                path = Path(folder) / f"las{version[2]}_{kind}{suffix}"
                las.write(path)
                names = tuple(name for name in las.point_format.dimension_names if name not in "XYZ")
                found.append(Example("LAS, LAZ 1.0 to 1.4, every point format", path.name, path.read_bytes(), names))
        cloud = PointCloud(P, {"NormalX": N[:, 0], "NormalY": N[:, 1], "NormalZ": N[:, 2]}, crs="EPSG:32633")
        path = Path(folder) / "extra.laz"
        write_cloud(path, cloud)
        header = laspy.LasHeader(version="1.4", point_format=6)
        names = tuple(name for name in header.point_format.dimension_names if name not in "XYZ")
        names += ("NormalX", "NormalY", "NormalZ")
        found.append(Example("LAS, LAZ: extra bytes, CRS", path.name, path.read_bytes(), names, close=1e-7))
        if find_spec("pye57"):
            cloud = PointCloud(P, {"intensity": I.astype(np.uint16), **dict(zip(COLORS, RGB.T, strict=True))})
            path = Path(folder) / "a.e57"
            write_cloud(path, cloud)
            found.append(Example("E57", path.name, path.read_bytes(), ("intensity", *COLORS)))
    return found


def parted_examples() -> list[Example]:
    """COPC and bags, whose points come in another order or as several scans: the fuzzer starts from them too."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_copc(folder / "a.copc.laz", P, levels=2, root=20)
        found.append(Example("COPC", "a.copc.laz", (folder / "a.copc.laz").read_bytes()))
        if find_spec("rosbags"):
            scan = bag_records(OUSTER, P.astype(np.float32))
            for kind in ("a.bag", "a.mcap"):
                path = write_bag(folder / kind, {"/lidar": [scan, scan]})
                found.append(Example("ROS 1 bag, ROS 2 bag, MCAP", kind, path.read_bytes()))
            write_bag(folder / "ros2", {"/lidar": [scan, scan]})
            database = next((folder / "ros2").glob("*.db3"))
            found.append(Example("ROS 1 bag, ROS 2 bag, MCAP", "a.db3", database.read_bytes()))
    return found


def examples() -> list[Example]:
    """All of them; E57 where pye57 is there."""
    return [
        *text_examples(), *ply_examples(), *pcd_examples(), *numpy_examples(), *bin_examples(), *mesh_examples(),
        *las_examples(),
    ]  # fmt: skip
