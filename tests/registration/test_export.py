"""The clouds and the JSON that a registration leaves behind."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fmr_cli import PointCloud, read_cloud, write_cloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.outputs import check_outputs, write_json
from fmr_cli.io.stream import collect
from fmr_cli.registration.export import aligned_cloud, merged_cloud
from fmr_cli.registration.result import plain

FAR = np.array([691_000.0, 5_335_000.0, 520.0])  # as UTM coordinates are
T = np.array([[0.0, -1, 0, FAR[0]], [1, 0, 0, FAR[1]], [0, 0, 1, FAR[2]], [0, 0, 0, 1]])  # a quarter turn about z


@pytest.fixture
def clouds() -> tuple[PointCloud, PointCloud]:
    """A source of 50 points, and its image 0.25 above as the target, with attributes of different kinds."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (50, 3)).round(3)
    source = PointCloud(
        points, {"red": np.arange(50, dtype=np.uint8), "nx": np.ones(50), "ny": np.zeros(50), "nz": np.zeros(50)}
    )
    above = points @ T[:3, :3].T + FAR + [0, 0, 0.25]
    target = PointCloud(above, {"red": np.full(50, 257 * 9, np.uint16), "gps_time": np.arange(50.0)}, crs="EPSG:25832")
    return source, target


def test_residuals_are_exact_far_from_the_origin(clouds):
    moved = collect(aligned_cloud(*clouds, T))
    np.testing.assert_allclose(moved.attributes["residual"], 0.25, atol=1e-6)
    np.testing.assert_allclose(moved.points, clouds[1].points - [0, 0, 0.25], rtol=0, atol=1e-9)


def test_the_moved_source_is_in_the_targets_reference_system(clouds):
    assert collect(aligned_cloud(*clouds, T)).crs == "EPSG:25832"


def test_merging_turns_the_sources_normals_and_fills_what_one_lacks(clouds):
    stream, warnings = merged_cloud(*clouds, T)
    merged = collect(stream)
    assert merged.attributes["source_id"].tolist() == [0] * 50 + [1] * 50
    np.testing.assert_allclose(merged.attributes["ny"][:50], 1)
    assert not merged.attributes["ny"][50:].any()
    assert not merged.attributes["gps_time"][:50].any()
    assert sum("gps_time" in warning for warning in warnings) == 1


def test_merging_brings_8_bit_colours_to_16_bits(clouds):
    red = collect(merged_cloud(*clouds, T)[0]).attributes["red"]
    assert red.dtype == np.uint16
    assert red[:50].tolist() == [257 * value for value in range(50)]
    assert set(red[50:]) == {257 * 9}


@pytest.mark.parametrize("suffix", [".las", ".ply", ".pcd", ".csv"])
def test_a_merged_cloud_comes_back_from_its_file(clouds, tmp_path, suffix):
    merged = collect(merged_cloud(*clouds, T)[0])
    write_cloud(tmp_path / f"merged{suffix}", merged)
    back = read_cloud(tmp_path / f"merged{suffix}")
    np.testing.assert_allclose(back.points, merged.points, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(back.attributes["source_id"], merged.attributes["source_id"])


def test_json_has_no_word_for_infinity(tmp_path):
    write_json(tmp_path / "m.json", plain({"rmse": np.float64("inf"), "T": np.eye(2), "n": np.int64(3)}))
    assert json.loads((tmp_path / "m.json").read_text()) == {"rmse": None, "T": [[1.0, 0.0], [0.0, 1.0]], "n": 3}


def test_outputs_are_checked_before_anything_is_computed(tmp_path):
    check_outputs([(tmp_path / "T.TXT", (".txt",)), (None, ())])
    for bad in (tmp_path / "T.doc", tmp_path / "no" / "T.txt", tmp_path):
        with pytest.raises(CloudFileError):
            check_outputs([(bad, (".txt",))])
