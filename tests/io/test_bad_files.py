"""Whatever is wrong with a file is one line that names it; nothing is allocated for a promise, nothing half-written."""

from __future__ import annotations

import os
import re
import struct
import subprocess
import sys
import tracemalloc
from importlib.util import find_spec
from pathlib import Path

import laspy
import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.io import WRITABLE, atomic_write, read_cloud, write_cloud

# E57 needs pye57, which is an extra
HERE = [suffix for suffix in WRITABLE if suffix != ".e57" or find_spec("pye57")]
XYZ = "property double x\nproperty double y\nproperty double z\n"
PLY = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + XYZ + "end_header\n"
PLY_TEXT = PLY.replace("binary_little_endian", "ascii")
FACES = PLY.replace("end_header", "element face 1\nproperty list int int vertex_indices\nend_header")
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {}\nHEIGHT 1\nPOINTS {}\nDATA {}\n"
HUGE = 10**15
MANY_PROPERTIES = "".join(f"property float p{k}\n" for k in range(10_001)) + "end_header"
PTX_HEADER = "0\n0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def pcd(count: object, kind: str) -> bytes:
    return PCD.format(count, count, kind).encode()


BAD = {
    "promise.ply": (PLY.format(HUGE).encode() + bytes(2400), "promises 1000000000000000"),
    "promise-text.ply": (PLY_TEXT.format(HUGE).encode() + b"1 2 3\n" * 9, "promises 1000000000000000"),
    "short.ply": (PLY.format(100).encode() + bytes(2399), "promises 100"),
    "short-text.ply": (PLY_TEXT.format(4).encode() + b"1.000000 2.000000 3.000000\n" * 3, "promises 4"),
    "negative.ply": (PLY.format(-5).encode() + bytes(2400), "line 3 is 'element vertex -5'"),
    "garbled.ply": (PLY.format("1e3").encode() + bytes(2400), "line 3"),
    "no-vertex.ply": (PLY.format(9).replace("vertex", "camera").encode() + bytes(2400), "no element 'vertex'"),
    "no-z.ply": (PLY.format(9).replace("double z", "double w").encode() + bytes(2400), "has no z"),
    "no-end.ply": (PLY.format(9)[:-11].encode(), "without an end"),
    "list.ply": (FACES.format(1).encode() + bytes(24) + struct.pack("<iii", 10**9, 0, 0), "'face' lists"),
    "list-negative.ply": (FACES.format(1).encode() + bytes(24) + struct.pack("<iii", -7, 0, 0), "'face' lists"),
    "face.ply": (FACES.format(1).encode() + bytes(24) + struct.pack("<iiii", 3, 0, 0, 7), "a vertex it does not have"),
    "words.ply": (PLY_TEXT.format(2).encode() + b"1 2 3\n1 two 3\n", "line 9: expected 3 numbers, found '1 two 3'"),
    "wide.ply": (
        PLY.replace("end_header", MANY_PROPERTIES).format(1).encode(),
        "declares 10004 properties of a vertex",
    ),
    "wide.pcd": (pcd(9, "ascii").replace(b"COUNT 1", b"COUNT 20000"), "declares 20002 values of a point"),
    "empty-scans.ptx": (PTX_HEADER.encode() * 2000, "holds 1000 scans of fewer than 10 points each"),
    "other.ply": (b"\x89PNG\r\n\x1a\n" + bytes(100), "not a PLY file"),
    "promise.pcd": (pcd(HUGE, "binary") + bytes(1200), "promises 1000000000000000"),
    "promise-text.pcd": (pcd(HUGE, "ascii") + b"1 2 3\n" * 9, "promises 1000000000000000"),
    "promise-packed.pcd": (pcd(HUGE, "binary_compressed") + bytes(1200), "promises 1000000000000000"),
    "packed.pcd": (pcd(100, "binary_compressed") + struct.pack("<II", 2**31, 1200) + bytes(99), "compressed data"),
    "short.pcd": (pcd(100, "binary") + bytes(1199), "promises 100"),
    "negative.pcd": (pcd(-1, "binary") + bytes(1200), "damaged PCD header"),
    "no-data.pcd": (pcd(9, "binary").replace(b"DATA", b"DTA"), "no complete PCD header"),
    "unknown.pcd": (pcd(9, "zipped") + bytes(1200), "unknown PCD encoding"),
    "odd.bin": (bytes(1601), "holds 1601 bytes, which is no number of points of 3 to 10 float32"),
    "nan.bin": (np.full(40, np.nan, "<f4").tobytes(), "none of its 10 points has finite coordinates"),
    "words.xyz": (b"1 2 3\n\n4 5 6\n7 eight 9\n", "line 4: expected 3 numbers, found '7 eight 9'"),
    "ragged.csv": (b"x,y,z\n1,2,3\n1,2\n", "line 3: expected 3 numbers, found '1,2'"),
    "narrow.txt": (b"1 2\n3 4\n", "line 1: has 2 columns"),
    "comments.txt": (b"# nothing\n\n", "holds no points"),
    "names.csv": (b"x,y,z\n", "holds no points"),
    "binary.xyz": (bytes(range(1, 200)), "line 1"),
    "not.npy": (b"anything", "is it damaged?"),
    "not.npz": (b"anything", "is it damaged?"),
    "not.las": (b"LASF" + bytes(90), "not a LAS file"),
    "counts.off": (b"OFF\n8 x 0\n", "line 2: expected the numbers of vertices and faces"),
    "short.off": (b"OFF\n1000000000 6 0\n0 0 0\n", "promises 1000000000 vertices and 6 faces, holds 1 and 0"),
    "face.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "line 6: expected 3 numbers"),
    "flat.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "without any surface"),
    "short.stl": (bytes(80) + struct.pack("<I", 10**9) + bytes(500), "promises 1000000000 triangles"),
    "cut.stl": (b"solid\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n", "not a complete STL file"),
    "unknown.dxf": (b"anything", "the suffix '.dxf' cannot be read, use one of .ply .pcd"),
    "suffixless": (b"anything", "has no suffix, use one of"),
    **{f"empty{suffix}": (b"", "is empty") for suffix in HERE},
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_said_in_one_line(tmp_path: Path, name: str) -> None:
    data, what = BAD[name]
    path = tmp_path / name
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(CloudFileError) as caught:
        read_cloud(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert what in message
    assert "\n" not in message
    assert peak < 20e6  # most of it modules that are imported


def test_missing_files_folders_and_permissions(tmp_path: Path) -> None:
    for path, what in ((tmp_path / "none.ply", "no such file"), (tmp_path / "dir.ply", "is a folder")):
        (tmp_path / "dir.ply").mkdir(exist_ok=True)
        with pytest.raises(CloudFileError, match=f"{re.escape(str(path))}: {what}"):
            read_cloud(path)


def las_file(path: Path) -> bytearray:
    cloud = PointCloud(np.random.default_rng(0).random((100, 3)), {"label": np.arange(100)})
    write_cloud(path, cloud)
    return bytearray(path.read_bytes())


@pytest.mark.parametrize(("place", "kind"), [(12, "<I"), (32, "<H")])  # points of a chunk; items of a point
def test_a_laz_whose_compression_is_not_said_rightly(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], place: int, kind: str
) -> None:
    path = tmp_path / "a.laz"
    write_cloud(path, PointCloud(np.random.default_rng(0).random((99, 3))))
    data = bytearray(path.read_bytes())
    record = data.index(b"laszip encoded") - 2 + 54  # behind the VLR's header
    struct.pack_into(kind, data, record + place, 0)
    path.write_bytes(data)
    with pytest.raises(CloudFileError, match="how its points are compressed, it is damaged: copy it again"):
        read_cloud(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_that_promises_too_much(tmp_path: Path, suffix: str) -> None:
    data = las_file(tmp_path / f"a{suffix}")
    data[247:255] = (10**12).to_bytes(8, "little")
    (tmp_path / f"b{suffix}").write_bytes(data)
    with pytest.raises(CloudFileError, match=r"promises 1000000000000 points and holds .*truncated"):
        read_cloud(tmp_path / f"b{suffix}")
    data[247:255] = bytes(8)
    (tmp_path / f"b{suffix}").write_bytes(data)
    with pytest.raises(CloudFileError, match="holds no points"):
        read_cloud(tmp_path / f"b{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".laz", ".npy", ".npz"])
def test_a_file_cut_anywhere_is_an_error(tmp_path: Path, suffix: str) -> None:
    write_cloud(tmp_path / f"a{suffix}", PointCloud(np.random.default_rng(0).random((60, 3)), {"label": np.arange(60)}))
    data = (tmp_path / f"a{suffix}").read_bytes()
    for length in [*range(1, len(data), 17), len(data) - 1]:
        (tmp_path / f"b{suffix}").write_bytes(data[:length])
        with pytest.raises(CloudFileError):
            read_cloud(tmp_path / f"b{suffix}")


def test_real_las_files_cut_short(shared_data: Path, tmp_path: Path) -> None:
    for name in ("autzen_trim.laz", "simple.las"):
        data = (shared_data / "las" / name).read_bytes()
        for share in (0.001, 0.1, 0.5, 0.9, 0.999):
            (tmp_path / name).write_bytes(data[: int(len(data) * share)])
            with pytest.raises(CloudFileError, match=re.escape(str(tmp_path / name))):
                read_cloud(tmp_path / name)
    with pytest.raises(CloudFileError, match="holds no points"):
        read_cloud(shared_data / "las" / "no-points.las")


FUZZ = """
import random, sys, warnings
from pathlib import Path
from fmr_cli.errors import FmrError
from fmr_cli.io import read_cloud
warnings.simplefilter("error")
rng = random.Random(1)
for valid in sorted(Path(sys.argv[1]).iterdir()):
    data = valid.read_bytes()
    path = Path(sys.argv[2]) / valid.name
    for _ in range(120):
        damaged = bytearray(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)
        for _ in range(rng.choice([0, 1, 1, 3])):
            if damaged:
                place = rng.randrange(min(len(damaged), rng.choice([100, 400, 10**6])))
                damaged[place] = rng.choice([0, 45, 57, 255, rng.randrange(256)])
        path.write_bytes(damaged)
        try:
            read_cloud(path, mesh_points=50)
        except FmrError as error:
            assert str(path) in str(error) and len(str(error).splitlines()) == 1, repr(error)
print("survived")
"""


def test_random_damage_ends_in_a_cloud_or_one_line(tmp_path: Path) -> None:
    """In a process of its own with little memory: a native library that allocates too much or aborts would end it."""
    (tmp_path / "valid").mkdir()
    (tmp_path / "damaged").mkdir()
    rng = np.random.default_rng(0)
    colors = {c: rng.integers(0, 256, 40).astype(np.uint8) for c in ("red", "green", "blue")}
    cloud = PointCloud(rng.random((40, 3)), {"intensity": np.arange(40, dtype=np.float32), **colors})
    for suffix in HERE:
        write_cloud(tmp_path / "valid" / f"a{suffix}", cloud)
    (tmp_path / "valid" / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    (tmp_path / "valid" / "b.ply").write_bytes(
        FACES.format(3).encode() + np.eye(3).tobytes() + struct.pack("<4i", 3, 0, 1, 2)
    )
    (tmp_path / "valid" / "b.pcd").write_bytes(pcd(9, "ascii") + b"1.5 2.5 3.5\n" * 9)
    header = laspy.LasHeader(version="1.2", point_format=3)
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(50, header=header))
    las.x = rng.random(50)
    las.write(tmp_path / "valid" / "old.laz")
    limited = "import resource; resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))\n" + FUZZ
    done = subprocess.run(
        [sys.executable, "-c", limited, str(tmp_path / "valid"), str(tmp_path / "damaged")],
        env={**os.environ, "OMP_NUM_THREADS": "1", "RAYON_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert (done.stdout, done.stderr, done.returncode) == ("survived\n", "", 0)


def test_nothing_is_written_where_the_output_folder_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "a.ply"
    with pytest.raises(CloudFileError, match=rf"output folder {re.escape(str(path.parent))} does not exist"):
        write_cloud(path, PointCloud(np.zeros((1, 3))))
    with pytest.raises(CloudFileError, match=r"cannot be written, use one of \.ply"):
        write_cloud(tmp_path / "a.obj", PointCloud(np.zeros((1, 3))))
    assert list(tmp_path.iterdir()) == []


def fail_halfway(path: Path, error: Exception | None = None) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error or ZeroDivisionError


def test_a_failure_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("before")
    with pytest.raises(CloudFileError, match="not fit into LAS"):  # the cloud cannot be written
        write_cloud(tmp_path / "a.las", PointCloud(np.full((1, 3), 1e200)))
    with pytest.raises(ZeroDivisionError):
        fail_halfway(path)
    assert path.read_text() == "before"
    with atomic_write(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        temporary.write_text("after")
        assert path.read_text() == "before"
    assert path.read_text() == "after"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_to_write_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(CloudFileError, match=rf"{re.escape(str(path))}: cannot be written \(No space left"):
        fail_halfway(path, OSError(28, "No space left on device"))
    with pytest.raises(FmrError, match="is a folder"):
        fail_halfway(tmp_path)
    assert list(tmp_path.iterdir()) == []
