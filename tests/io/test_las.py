"""LAS and LAZ: all versions and point formats, the header, scale and offset."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.io import read_cloud, write_cloud

WKT = 'PROJCS["somewhere",UNIT["metre",1]]'
TURN = np.array([[0.6, -0.8, 0, 30], [0.8, 0.6, 0, -20], [0, 0, 1, 5], [0, 0, 0, 1.0]])


def filled(version: str, point_format: int, path: Path, n: int = 200) -> laspy.LasData:
    """Writes a file with random values in every dimension and in extra bytes, and gives what was written."""
    rng = np.random.default_rng(point_format)
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.array([0.01, 0.01, 0.001]), np.array([500_000.0, 4_000_000.0, 0.0])
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.vlrs.append(laspy.VLR("mine", 7, "a note", b"anything"))
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(WKT))
    header.add_extra_dims([
        laspy.ExtraBytesParams("height", "f8"),
        laspy.ExtraBytesParams("vector", "3i2", description="three"),
        laspy.ExtraBytesParams("scaled", "i4", scales=np.array([0.01]), offsets=np.array([5.0])),
    ])  # fmt: skip
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    raw = rng.integers(0, 256, (n, las.points.array.dtype.itemsize), dtype=np.uint8)
    las.points.array[:] = raw.view(las.points.array.dtype)[:, 0]
    for name in "XYZ":
        las[name] = rng.integers(-(10**7), 10**7, n)
    if header.point_format.has_waveform_packet:
        las["wavepacket_offset"] = rng.integers(60, 10**9, n)
        if point_format >= 9:
            las["scanner_channel"] = np.zeros(n, np.uint8)  # lazrs garbles the waveform fields of several
    for name in [d.name for d in header.point_format.dimensions if d.kind.letter() == "f"]:
        las[name] = rng.random(n)
    las.write(path)
    return las


VERSIONS = [("1.1", 0), ("1.1", 1), ("1.2", 2), ("1.2", 3), ("1.3", 4), ("1.3", 5)]


@pytest.mark.parametrize(("version", "point_format"), [*VERSIONS, *[("1.4", k) for k in range(11)]])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_every_point_format_is_written_as_it_was_read(
    tmp_path: Path, version: str, point_format: int, suffix: str
) -> None:
    made = filled(version, point_format, tmp_path / f"a{suffix}")
    cloud = read_cloud(tmp_path / f"a{suffix}")
    assert np.array_equal(cloud.points, made.xyz)
    assert write_cloud(tmp_path / f"b{suffix}", cloud) == []
    back = laspy.read(tmp_path / f"b{suffix}")
    assert back.points.array.tobytes() == made.points.array.tobytes()
    assert back.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert back.header.vlrs.get_by_id("mine")[0].record_data == b"anything"
    assert cloud.crs == read_cloud(tmp_path / f"b{suffix}").crs == WKT


def test_laz_waveforms_of_several_channels_are_left_out_with_a_word(tmp_path: Path) -> None:
    filled("1.4", 9, tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    cloud.attributes["scanner_channel"][::2] = 1
    (warning,) = write_cloud(tmp_path / "b.laz", cloud)
    assert "waveform fields are left out" in warning
    back = read_cloud(tmp_path / "b.laz")
    assert "waveform fields" in back.left_out[0]
    assert all(np.array_equal(v, cloud.attributes[name]) for name, v in back.attributes.items())
    assert write_cloud(tmp_path / "c.las", cloud) == []


def test_las_1_0_is_read_and_goes_on_as_1_2(tmp_path: Path) -> None:
    made = filled("1.1", 1, tmp_path / "a.las")
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[25] = 0
    (tmp_path / "a.las").write_bytes(data)
    cloud = read_cloud(tmp_path / "a.las")
    assert np.array_equal(cloud.points, made.xyz)
    write_cloud(tmp_path / "b.las", cloud)
    assert laspy.read(tmp_path / "b.las").points.array.tobytes() == made.points.array.tobytes()


def test_undeclared_extra_bytes_survive(tmp_path: Path) -> None:
    filled("1.2", 3, tmp_path / "a.las")
    data = (tmp_path / "a.las").read_bytes()
    (tmp_path / "a.las").write_bytes(data.replace(b"LASF_Spec", b"Somethin.", 1))  # hides the record that declares them
    cloud = read_cloud(tmp_path / "a.las")
    assert cloud.attributes["ExtraBytes"].shape == (200, 18)
    write_cloud(tmp_path / "b.las", cloud)
    before, after = laspy.read(tmp_path / "a.las"), laspy.read(tmp_path / "b.las")
    assert after.points.array.tobytes() == before.points.array.tobytes()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_select_and_transform_keep_what_belongs_to_a_point(tmp_path: Path, suffix: str) -> None:
    filled("1.4", 7, tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    moved = cloud.select(np.arange(0, 200, 3)).transformed(TURN)
    write_cloud(tmp_path / f"b{suffix}", moved)
    back = read_cloud(tmp_path / f"b{suffix}")
    assert (np.abs(back.points - moved.points) <= cloud.las_header.scales / 2 + 1e-9).all()
    assert np.array_equal(back.las_header.scales, cloud.las_header.scales)
    assert list(back.attributes) == list(cloud.attributes)
    assert all(np.array_equal(v, cloud.attributes[name][::3]) for name, v in back.attributes.items())


def test_offset_moves_only_where_it_must_and_nothing_is_clipped(tmp_path: Path) -> None:
    filled("1.2", 1, tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    cloud.points[:] = np.random.default_rng(0).random((200, 3)) * 100 + [5e8, 4.0001e6, 10]
    assert write_cloud(tmp_path / "b.las", cloud) == []
    back = read_cloud(tmp_path / "b.las")
    assert np.array_equal(back.las_header.scales, [0.01, 0.01, 0.001])
    assert back.las_header.offsets[1:].tolist() == [4e6, 0]
    assert (np.abs(back.points - cloud.points) <= cloud.las_header.scales / 2 + 1e-7).all()


def test_scale_grows_only_where_the_extent_leaves_no_choice(tmp_path: Path) -> None:
    filled("1.2", 1, tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    cloud.points[0] = [-3e8, 0, 0]
    (warning,) = write_cloud(tmp_path / "b.las", cloud)
    assert warning.startswith("x spans too much for LAS at the file's scale")
    back = read_cloud(tmp_path / "b.las")
    assert np.allclose(back.las_header.scales, [0.1, 0.01, 0.001])
    assert (np.abs(back.points - cloud.points) <= back.las_header.scales / 2 + 1e-7).all()


def test_a_change_of_unit_changes_the_scale(tmp_path: Path) -> None:
    filled("1.2", 1, tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las").transformed(np.diag([0.001, 0.001, 0.001, 1]))
    write_cloud(tmp_path / "b.las", cloud)
    assert np.abs(read_cloud(tmp_path / "b.las").points - cloud.points).max() < 0.51e-5


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e5])
def test_other_formats_get_a_scale_that_fits_their_size(tmp_path: Path, size: float) -> None:
    cloud = PointCloud(np.random.default_rng(0).random((300, 3)) * size + [6e5, 5e6, 0])
    write_cloud(tmp_path / "a.las", cloud)
    assert np.abs(read_cloud(tmp_path / "a.las").points - cloud.points).max() <= max(size * 1e-8, 1e-9)


def test_attributes_of_other_formats_in_las(tmp_path: Path) -> None:
    n = 50
    rng = np.random.default_rng(0)
    colors = {c: rng.integers(0, 256, n).astype(np.uint8) for c in ("red", "green", "blue")}
    cloud = PointCloud(
        rng.random((n, 3)),
        {
            **colors,
            "intensity": rng.random(n).astype(np.float32),
            "classification": rng.integers(0, 9, n),
            "a name of more than thirty-two bytes": np.arange(n) > 9,
            "hist": rng.random((n, 5)),
        },
        crs="EPSG:25832",
    )
    warnings = write_cloud(tmp_path / "a.las", cloud)
    assert len(warnings) == 2
    las = laspy.read(tmp_path / "a.las")
    assert (las.header.version.minor, las.header.point_format.id) == (4, 7)
    assert np.array_equal(las.red, colors["red"] * np.uint16(257))
    assert np.array_equal(las.classification, cloud.attributes["classification"])
    back = read_cloud(tmp_path / "a.las")
    assert back.crs == "EPSG:25832"
    assert np.array_equal(back.attributes["intensity"], cloud.attributes["intensity"])
    assert np.array_equal(back.attributes["hist_4"], cloud.attributes["hist"][:, 4])
    write_cloud(tmp_path / "a.ply", back)
    assert np.array_equal(read_cloud(tmp_path / "a.ply").attributes["red"], colors["red"])  # 8 bits again


def test_a_cloud_takes_over_another_reference_system_and_colours(tmp_path: Path) -> None:
    filled("1.1", 1, tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    cloud.crs = "EPSG:4326"
    cloud.attributes |= {c: np.full(200, 7, np.uint16) for c in ("red", "green", "blue")}
    write_cloud(tmp_path / "b.las", cloud)
    back = read_cloud(tmp_path / "b.las")
    assert back.crs == "EPSG:4326"
    assert back.las_header.point_format.id == 3
    assert np.array_equal(back.attributes["red"], np.full(200, 7))
    assert np.array_equal(back.attributes["scaled"], cloud.attributes["scaled"])


@pytest.mark.parametrize("name", ["1.2-with-color.las", "autzen_trim.las", "autzen_trim.laz", "extrabytes.las",
                                  "mvk-thin.las", "simple.las", "test1_4.las"])  # fmt: skip
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_real_files_come_back_to_the_last_bit(shared_data: Path, tmp_path: Path, name: str, suffix: str) -> None:
    cloud = read_cloud(shared_data / "las" / name)
    assert write_cloud(tmp_path / f"b{suffix}", cloud) == []
    before, after = laspy.read(shared_data / "las" / name), laspy.read(tmp_path / f"b{suffix}")
    assert before.points.array.tobytes() == after.points.array.tobytes()
    kept = [[v.record_data_bytes() for v in las.vlrs if v.user_id != "LASF_Spec"] for las in (before, after)]
    assert kept[0] == kept[1]
    assert before.header.global_encoding.value == after.header.global_encoding.value
