"""Coordinate reference systems: which are one, which is in degrees, reprojection."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, RegistrationError
from fmr_cli.io import crs, read_cloud, write_cloud
from fmr_cli.io.stream import stream_of
from fmr_cli.registration import Options, align

UTM33 = (
    'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],'
    'AUTHORITY["EPSG","4326"]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32633"]]'
)
COMPOUND = (
    f'COMPD_CS["both",{UTM33},VERT_CS["EGM96",VERT_DATUM["EGM96",2005],UNIT["metre",1],AUTHORITY["EPSG","5773"]]]'
)
ESRI = UTM33.replace("WGS 84 / UTM zone 33N", "WGS_1984_UTM_Zone_33N").replace(',AUTHORITY["EPSG","32633"]', "")


def test_codes_names_and_sameness() -> None:
    assert crs.code_of(UTM33) == crs.code_of(COMPOUND) == crs.code_of("epsg:32633") == "EPSG:32633"
    assert crs.code_of(ESRI) is None
    assert crs.name_of(COMPOUND) == "WGS 84 / UTM zone 33N (EPSG:32633)"
    for one in (UTM33, COMPOUND, "EPSG:32633", ESRI):
        assert crs.same(UTM33, one)
        assert crs.same(UTM33.replace("33", "32"), one) is False or one == ESRI
    assert crs.same("EPSG:32633", "EPSG:32632") is False


@pytest.mark.parametrize("text", ["", "[", 'PROJCS["', "))((", 'A["b",C["d"]', "\x00" * 9, "[" * 5000])
def test_what_is_no_wkt_does_no_harm(text: str) -> None:
    assert crs.code_of(text) is None
    assert crs.same(text, "EPSG:4326") in (False, None)


def test_degrees_are_told_by_the_system_and_the_values() -> None:
    low, high = np.array([15.0, 45.0, 0.0]), np.array([15.01, 45.01, 30.0])
    assert crs.in_degrees("EPSG:4326", low, high)
    assert not crs.in_degrees("EPSG:32633", low, high)
    assert not crs.in_degrees("EPSG:4326", low * 1000, high * 1000)  # a system that the values contradict


def test_two_systems_and_degrees_are_refused_by_a_registration() -> None:
    points = np.random.default_rng(0).uniform(0, 10, (500, 3))
    a, b = PointCloud(points, crs="EPSG:32633"), PointCloud(points, crs="EPSG:32632")
    with pytest.raises(RegistrationError, match=r"EPSG:32633 and .* in EPSG:32632: bring them into one .*--crs"):
        align(a, b, Options())
    degrees = PointCloud(points * 1e-5 + [15, 45, 0], crs="EPSG:4326")
    with pytest.raises(RegistrationError, match=r"is in degrees \(EPSG:4326\)"):
        align(degrees, degrees, Options())


@pytest.mark.skipif(not find_spec("pyproj"), reason="pyproj is not installed")
def test_reprojection(tmp_path: Path) -> None:
    points = np.array([[15.0, 45.0, 100.0], [15.001, 45.001, 120.0]])
    cloud = PointCloud(points, {"intensity": np.array([1, 2], np.uint16)}, crs="EPSG:4326")
    write_cloud(tmp_path / "a.las", cloud)
    moved = crs.reprojected(stream_of(read_cloud(tmp_path / "a.las")), "EPSG:32633")
    assert write_cloud(tmp_path / "b.las", moved) == []
    back = read_cloud(tmp_path / "b.las")
    assert back.points[0] == pytest.approx([500_000, 4_982_950.4, 100], abs=0.001)  # on the meridian of the zone
    assert crs.code_of(back.crs) == "EPSG:32633"
    assert np.linalg.norm(np.diff(back.points[:, :2], axis=0)) == pytest.approx(136.2, abs=0.5)  # metres of 0.001 deg
    with pytest.raises(CloudFileError, match="give one such as EPSG:32633"):
        crs.reprojected(stream_of(cloud), "EPSG:99999999")
    with pytest.raises(CloudFileError, match="states no coordinate reference system"):
        crs.reprojected(stream_of(PointCloud(points)), "EPSG:32633")
