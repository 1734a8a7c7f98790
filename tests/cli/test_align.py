"""`fmr align`: what it writes, what it says, and how it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fmr_cli import PointCloud, read_cloud, read_transform, write_cloud
from fmr_cli.cloud import transform_points

UTM = np.array([691_000.0, 5_335_000.0, 520.0])


@pytest.fixture(scope="module")
def run(tmp_path_factory, fmr_process, samples):
    """One run that writes everything there is to write: (folder, process)."""
    folder = tmp_path_factory.mktemp("align")
    outputs = ["-o", "T.txt", "--aligned", "moved.ply", "--merged", "both.pcd", "--metrics", "metrics.json", "--json"]
    return folder, fmr_process("align", samples / "scan_a.ply", samples / "scan_b.ply", *outputs, cwd=folder)


def test_the_samples_are_aligned(run, truth, pose_error):
    folder, done = run
    assert done.returncode == 0, done.stderr
    degrees, metres = pose_error(read_transform(folder / "T.txt"), truth)
    assert degrees < 0.5
    assert metres < 0.02
    assert done.stderr.startswith("aligned")
    assert len(done.stderr.splitlines()) == 1


def test_json_is_the_metrics_and_can_be_piped(run, samples):
    folder, done = run
    said = json.loads(done.stdout)
    assert said == json.loads((folder / "metrics.json").read_text())
    assert said["status"] == "aligned"
    assert said["T_target_source"] == read_transform(folder / "T.txt").tolist()
    assert said["source"] == {"file": str(samples / "scan_a.ply"), "points": 8000, "dropped": 0}
    expected = {"confidence", "overlap", "inlier_rmse", "feature_errors", "angle", "shift", "iterations", "points"}
    assert expected | {"seconds", "versions", "options", "start"} <= set(said)
    assert {"total"} < set(said["seconds"])
    assert said["options"]["seed"] == 0


def test_the_moved_source_keeps_its_attributes_and_gains_a_residual(run, samples):
    folder, _ = run
    source, moved = read_cloud(samples / "scan_a.ply"), read_cloud(folder / "moved.ply")
    np.testing.assert_allclose(moved.points, transform_points(read_transform(folder / "T.txt"), source.points))
    assert set(moved.attributes) == {"red", "green", "blue", "residual"}
    for name, values in source.attributes.items():
        np.testing.assert_array_equal(moved.attributes[name], values)
    assert np.median(moved.attributes["residual"]) < 0.1


def test_the_merged_cloud_says_which_point_is_whose(run, samples):
    folder, _ = run
    merged, target = read_cloud(folder / "both.pcd"), read_cloud(samples / "scan_b.ply")
    assert np.bincount(merged.attributes["source_id"]).tolist() == [8000, 8000]
    np.testing.assert_array_equal(merged.points[8000:], target.points)
    np.testing.assert_array_equal(merged.attributes["red"][8000:], target.attributes["red"])


def test_without_an_output_the_matrix_alone_is_printed_the_same_on_every_run(run, fmr):
    folder, _ = run
    done = fmr("align", "scan_a.ply", "scan_b.ply", "--quiet")
    assert done.stderr == ""
    assert done.stdout == (folder / "T.txt").read_text()


@pytest.mark.parametrize(("scale", "origin"), [(1000.0, 0 * UTM), (1.0, UTM)], ids=["millimetres", "UTM"])
def test_unit_and_origin_change_nothing_but_the_answers_unit(run, fmr, samples, tmp_path, scale, origin):
    for name in ("scan_a", "scan_b"):
        points = read_cloud(samples / f"{name}.ply", attributes=False).points
        write_cloud(tmp_path / f"{name}.ply", PointCloud(points * scale + origin))
    done = fmr("align", "scan_a.ply", "scan_b.ply", "-o", "T.npy", "--aligned", "moved.ply", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    expected = read_cloud(run[0] / "moved.ply", attributes=False).points * scale + origin
    moved = read_cloud(tmp_path / "moved.ply", attributes=False).points
    assert np.abs(moved - expected).max() < 1e-4 * scale
    source = read_cloud(tmp_path / "scan_a.ply", attributes=False).points
    np.testing.assert_allclose(transform_points(read_transform(tmp_path / "T.npy"), source), moved, atol=1e-8 * scale)


def test_a_start_from_a_file(run, fmr, tmp_path, samples, truth, pose_error):
    scans = (samples / "scan_a.ply", samples / "scan_b.ply")
    done = fmr("align", *scans, "--init", samples / "truth.txt", "-o", "T.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert max(pose_error(read_transform(tmp_path / "T.json"), truth)) < 0.5


def test_scans_of_different_things_are_uncertain_and_still_written(fmr, samples, tmp_path):
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3))  # of the scan's size: a smaller one would be sought all over it
    write_cloud(tmp_path / "ball.ply", PointCloud(4 * ball / np.linalg.norm(ball, axis=1, keepdims=True)))
    done = fmr("align", "ball.ply", samples / "scan_b.ply", "-o", "T.txt", cwd=tmp_path)
    assert done.returncode == 3
    assert done.stderr.startswith("uncertain")
    assert read_transform(tmp_path / "T.txt").shape == (4, 4)


def test_points_without_finite_coordinates_are_counted(fmr, samples, tmp_path):
    points = read_cloud(samples / "scan_a.ply", attributes=False).points
    points[::100] = np.nan
    np.save(tmp_path / "holes.npy", points)
    done = fmr("align", "holes.npy", samples / "scan_b.ply", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "80 points" in done.stderr


def test_a_moved_las_comes_back_to_its_place_with_its_attributes_and_crs(fmr, shared_data, tmp_path):
    original = read_cloud(shared_data / "las" / "autzen_trim.las")
    centre, angle = original.points.mean(0), np.radians(2)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = centre - T[:3, :3] @ centre + [7, -4, 2]
    write_cloud(tmp_path / "moved.las", original.transformed(T))
    target = shared_data / "las" / "autzen_trim.las"
    done = fmr("align", "moved.las", target, "-o", "T.txt", "--aligned", "back.las", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    back = read_cloud(tmp_path / "back.las")
    assert np.linalg.norm(back.points - original.points, axis=1).max() < 0.02
    assert back.crs == original.crs
    assert back.attributes["residual"].max() < 0.05
    for name in ("red", "green", "blue", "gps_time", "intensity"):
        np.testing.assert_array_equal(back.attributes[name], original.attributes[name])


def test_two_fragments_of_a_room_turned_at_random(fmr, shared_data, tmp_path, pose_error):
    folder = shared_data / "redkitchen" / "fragments"
    poses = [np.loadtxt(folder / f"cloud_bin_{i}.pose.txt") for i in (0, 1)]
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn[:3, :3] *= np.linalg.det(turn[:3, :3])
    source = read_cloud(folder / "cloud_bin_1.ply", attributes=False)
    write_cloud(tmp_path / "turned.ply", source.transformed(turn))
    done = fmr("align", "turned.ply", folder / "cloud_bin_0.ply", "-o", "T.txt", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    degrees, metres = pose_error(read_transform(tmp_path / "T.txt") @ turn, np.linalg.inv(poses[0]) @ poses[1])
    assert degrees < 5
    assert metres < 0.1


BAD = {
    "no file": (["missing.ply", "b.ply"], "missing.ply"),
    "no points": (["empty.ply", "b.ply"], "empty.ply"),
    "no format": (["notes.docx", "b.ply"], "notes.docx"),
    "few points": (["nine.xyz", "b.ply"], "nine.xyz"),
    "one place": (["place.xyz", "b.ply"], "place.xyz"),
    "no folder": (["a.ply", "b.ply", "-o", "there/T.txt"], "there"),
    "no transform suffix": (["a.ply", "b.ply", "-o", "T.mat"], "T.mat"),
    "no cloud suffix": (["a.ply", "b.ply", "--aligned", "moved.doc"], "moved.doc"),
    "a mesh to write": (["a.ply", "b.ply", "--merged", "both.stl"], "both.stl"),
    "no metrics suffix": (["a.ply", "b.ply", "--metrics", "m.txt"], "m.txt"),
    "one name twice": (["a.ply", "b.ply", "--aligned", "x.ply", "--merged", "x.ply"], "x.ply"),
    "no start": (["a.ply", "b.ply", "--init", "guess"], "guess"),
    "no rotation": (["a.ply", "b.ply", "--init", "shear.txt"], "shear.txt"),
    "no model": (["a.ply", "b.ply", "--model", "mine.safetensors"], "mine.safetensors"),
}


@pytest.mark.parametrize(("arguments", "named"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_leaves_nothing(fmr, samples, tmp_path, arguments, named):
    (tmp_path / "a.ply").symlink_to(samples / "scan_a.ply")
    (tmp_path / "b.ply").symlink_to(samples / "scan_b.ply")
    (tmp_path / "empty.ply").touch()
    (tmp_path / "notes.docx").write_text("notes")
    np.savetxt(tmp_path / "nine.xyz", np.eye(3).repeat(4, 0) + np.eye(12, 3))
    np.savetxt(tmp_path / "place.xyz", np.ones((50, 3)))
    np.savetxt(tmp_path / "shear.txt", np.eye(4) + np.eye(4, k=1))
    before = sorted(tmp_path.iterdir())
    done = fmr("align", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert named in done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.skipif("__import__('torch').cuda.is_available()", reason="this machine has a GPU")
def test_a_gpu_that_is_not_there(fmr):
    done = fmr("align", "scan_a.ply", "scan_b.ply", "--device", "cuda")
    assert done.returncode == 2
    assert "cuda" in done.stderr
