"""`fmr transform`: a saved transform applied, any format to any format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.io import read_cloud, write_cloud, write_transform

Fmr = Callable[..., object]

T = np.array([[0, -1, 0, 100], [1, 0, 0, -50], [0, 0, 1, 7], [0, 0, 0, 1.0]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    attributes = {"nx": np.ones(50), "ny": np.zeros(50), "nz": np.zeros(50), "label": np.arange(50, dtype=np.uint8)}
    write_cloud(tmp_path / "a.ply", PointCloud(rng.random((50, 3)), attributes, sensor_origin=np.array([1.0, 2, 3])))
    write_transform(tmp_path / "T.txt", T)
    return tmp_path


def test_points_normals_and_the_sensor_move_and_the_rest_stays(folder: Path, fmr: Fmr) -> None:
    done = fmr("transform", "a.ply", "T.txt", "-o", "b.pcd", cwd=folder)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    a, b = read_cloud(folder / "a.ply"), read_cloud(folder / "b.pcd")
    assert np.array_equal(b.points, np.stack([100 - a.points[:, 1], a.points[:, 0] - 50, a.points[:, 2] + 7], 1))
    assert b.attributes["ny"].tolist() == [1] * 50
    assert not b.attributes["nx"].any()
    assert np.array_equal(b.attributes["label"], a.attributes["label"])
    assert b.sensor_origin.tolist() == [98, -49, 10]


def test_inverse_brings_it_back(folder: Path, fmr: Fmr) -> None:
    assert fmr("transform", "a.ply", "T.txt", "-o", "b.ply", cwd=folder).returncode == 0
    assert fmr("transform", "b.ply", "T.txt", "-o", "c.ply", "--inverse", cwd=folder).returncode == 0
    a, c = read_cloud(folder / "a.ply"), read_cloud(folder / "c.ply")
    assert np.abs(a.points - c.points).max() < 1e-13


def test_what_is_lost_is_said_on_stderr(folder: Path, fmr: Fmr) -> None:
    done = fmr("transform", "a.ply", "T.txt", "-o", "b.bin", cwd=folder)
    assert done.returncode == 0
    assert "warning: .bin cannot hold the attributes nx, ny, nz, label: left out" in done.stderr.splitlines()
    assert fmr("transform", "a.ply", "T.txt", "-o", "b.bin", "--quiet", cwd=folder).stderr == ""


def test_a_real_las_file_keeps_everything_but_its_place(shared_data: Path, tmp_path: Path, fmr_process: Fmr) -> None:
    angle = np.radians(3)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:3, 3] = [5, -3, 1]
    write_transform(tmp_path / "T.npy", turn)
    source = shared_data / "las" / "autzen_trim.las"
    done = fmr_process("transform", source, "T.npy", "-o", "b.laz", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    a, b = read_cloud(source), read_cloud(tmp_path / "b.laz")
    assert np.abs(b.points - a.transformed(turn).points).max() <= 0.005 + 1e-9
    assert b.crs == a.crs
    assert b.las_header.scales.tolist() == [0.01, 0.01, 0.01]
    assert list(a.attributes) == list(b.attributes)
    assert all(np.array_equal(values, b.attributes[name]) for name, values in a.attributes.items())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none.ply", "T.txt", "-o", "b.ply"), "fmr: none.ply: no such file"),
        (("a.ply", "none.txt", "-o", "b.ply"), "fmr: none.txt: no such file"),
        (("a.ply", "a.ply", "-o", "b.ply"), "fmr: a.ply: line 1: expected numbers"),
        (("a.ply", "T.txt", "-o", "none/b.ply"), "fmr: none/b.ply: the output folder none does not exist"),
        (("a.ply", "T.txt", "-o", "b.docx"), "fmr: b.docx: cannot write the suffix '.docx', use one of .ply"),
        (("a.ply", "T.txt", "-o", "b.off"), "fmr: b.off: cannot write the suffix '.off', use one of .ply"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_written(folder: Path, fmr: Fmr, arguments: tuple, message: str) -> None:
    before = sorted(folder.iterdir())
    done = fmr("transform", *arguments, cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(message)
    assert len(done.stderr.splitlines()) == 1
    assert sorted(folder.iterdir()) == before
