"""Transforms and poses are read back bit for bit, and nonsense is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.errors import CloudFileError
from fmr_cli.io import read_poses, read_transform, write_poses, write_transform

T = np.eye(4)
T[:3, :3] = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
T[:3, :3] *= np.linalg.det(T[:3, :3])
T[:3, 3] = [637_123.456789, -1 / 3, 1e-9]


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".json"])
def test_a_transform_comes_back_bit_for_bit(tmp_path: Path, suffix: str) -> None:
    write_transform(tmp_path / f"T{suffix}", T)
    assert np.array_equal(read_transform(tmp_path / f"T{suffix}"), T)


def test_text_has_four_rows_of_four(tmp_path: Path) -> None:
    write_transform(tmp_path / "T.txt", T)
    assert [len(line.split()) for line in (tmp_path / "T.txt").read_text().splitlines()] == [4] * 4


@pytest.mark.parametrize(
    "text",
    [
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n",
        "1,0,0,5\n0,1,0,6\n0,0,1,7\n0,0,0,1\n",
        "# by hand\n\n1 0 0 5 0 1 0 6 0 0 1 7\n",
        '{"status": "aligned", "T_target_source": [[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]}',
        "[[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]",
    ],
)
def test_what_other_tools_write_is_understood(tmp_path: Path, text: str) -> None:
    path = tmp_path / ("T.json" if text[0] in "{[" else "T.txt")
    path.write_text(text)
    assert read_transform(path)[:3, 3].tolist() == [5, 6, 7]


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("T.txt", "1 0 0\n0 1 0\n0 0 1\n", "holds 9 numbers"),
        ("T.txt", "1 0 0 0\n0 one 0 0\n", "line 2: expected numbers, found '0 one 0 0'"),
        ("T.txt", "1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "not finite"),
        ("T.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n", "last row is not 0 0 0 1"),
        ("T.txt", "1 1 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "no rotation"),
        ("T.txt", "-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "no rotation"),
        ("T.txt", "", "is empty"),
        ("T.json", '{"a": 1}', "has none of T_target_source"),
        ("T.json", "{", "cannot be read as a transform"),
        ("T.npy", "not numpy", "cannot be read as a transform"),
    ],
)
def test_nonsense_is_refused(tmp_path: Path, name: str, text: str, what: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CloudFileError) as caught:
        read_transform(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert what in str(caught.value)


def test_poses_come_back_bit_for_bit(tmp_path: Path) -> None:
    poses = np.stack([np.eye(4), T, T @ T])
    write_poses(tmp_path / "poses.txt", poses)
    assert np.array_equal(read_poses(tmp_path / "poses.txt"), poses)
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 2 3\n")
    with pytest.raises(CloudFileError, match="pose 2 has 3 numbers, KITTI rows have 12"):
        read_poses(tmp_path / "poses.txt")


def test_real_poses_are_read(shared_data: Path) -> None:
    assert read_poses(shared_data / "hdl64" / "reference_poses.txt").shape == (22, 4, 4)
    pose = read_transform(shared_data / "redkitchen" / "fragments" / "cloud_bin_1.pose.txt")
    assert json.loads(json.dumps(pose.tolist()))[3] == [0, 0, 0, 1]
