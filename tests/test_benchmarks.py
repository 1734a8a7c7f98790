"""The benchmarks run, and measure what they say. No times are asserted."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from benchmarks import drives, paper, speed, starts
from benchmarks.common import PROTOCOLS, interleaved, make_pair, room_clouds
from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.se3 import exp
from fmr_cli.io import write_cloud
from fmr_cli.registration.models import bundled_encoder

ROOT = Path(__file__).parents[1]


def run(module: str, *arguments: str) -> str:
    """What ``python -m MODULE ARGUMENTS`` prints, run here: to start a process with torch takes seconds."""
    out = io.StringIO()
    with mock.patch.object(sys, "argv", [module, *arguments]), contextlib.chdir(ROOT), contextlib.redirect_stdout(out):
        importlib.import_module(module).main()
    return out.getvalue()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_truth_of_a_pair_is_exact(protocol: str) -> None:
    cloud = room_clouds(1, 2000, 0)[0]
    source, target, T = make_pair(protocol, cloud, np.random.default_rng(1))
    back = transform_points(np.linalg.inv(T), target)
    assert pose_error(T, T, source.mean(0)) == pytest.approx((0, 0), abs=1e-5)
    if protocol in ("copy", "so3", "density"):
        assert len(np.unique(np.round(np.concatenate([source, back]), 9), axis=0)) == len(back)
    if protocol == "density":
        assert len(source) == len(target) // 10
    if protocol.startswith("overlap"):
        assert len(source) == pytest.approx(len(target), rel=0.15)
        assert len(source) < 1000  # a half that lacks one end
    if protocol != "so3":
        assert pose_error(T, np.eye(4), np.zeros(3))[0] <= 60


def test_the_paper_s_algorithm_finds_the_pose() -> None:
    cloud = room_clouds(1, 3000, 3)[0]
    points = ((cloud - cloud.mean(0)) / (2 * np.abs(cloud - cloud.mean(0)).max())).astype(np.float32)
    T = exp(np.array([0.2, 0.1, -0.3, 0.02, 0.01, 0.03]))
    source = transform_points(np.linalg.inv(T), points).astype(np.float32)
    for normalised in (False, True):
        net = paper.PointNet(bundled_encoder(), normalised)
        found = paper.solve(net, torch.from_numpy(source)[None], torch.from_numpy(points)[None])
        np.testing.assert_allclose(found[0], T, rtol=0, atol=1e-4)


def test_runs_take_turns() -> None:
    order: list[str] = []
    seconds = interleaved({name: lambda name=name: order.append(name) for name in "ab"}, 2)  # type: ignore[misc]
    assert "".join(order) == "ababab"
    assert [len(s) for s in seconds.values()] == [2, 2]


def test_ic_is_compared_at_the_same_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "CORES", 1)
    rows = speed.ic(speed.Setup(room_clouds(1, 1000, 2), 0.05, 1, 1, 1, [], 0))
    assert rows[0]["times faster"] == 1
    assert all(row["off, deg"] < 0.01 for row in rows)


def test_speed_writes_a_report_and_a_plot(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    small = ["--points", "1000", "--clouds", "1", "--las-points", "3000"]
    said = run("benchmarks.speed", "--only", "las", *small, "--out", str(tmp_path / "speed"))
    assert "reading them alone" in said
    assert json.loads((tmp_path / "speed.json").read_text())["las"][0]["GiB"] > 0
    assert (tmp_path / "speed.png").stat().st_size > 1000


@pytest.mark.slow
def test_accuracy_of_a_folder(tmp_path: Path) -> None:
    for number, cloud in enumerate(room_clouds(2, 1500, 1)):
        write_cloud(tmp_path / f"{number}.ply", PointCloud(cloud))
    few = ["--pairs", "2", "--only", "copy"]
    said = run("benchmarks.accuracy", "--data", str(tmp_path), *few, "--out", str(tmp_path / "a"))
    assert "2 clouds of 1,500 points" in said
    rows = json.loads((tmp_path / "a.json").read_text())["rows"]
    assert rows[0]["method"] == "fmr"
    assert rows[0]["recall"] == 1.0


@pytest.mark.slow
def test_the_card_of_the_encoder_can_be_measured_again() -> None:
    said = run("benchmarks.encoders", "models/base.safetensors", "--pairs", "1")
    for clouds in ("shapes", "others", "rooms"):
        assert clouds in said


@pytest.mark.slow
def test_calibrate_writes_weights_in_the_form_of_the_bundled_ones(tmp_path: Path) -> None:
    said = run("benchmarks.calibrate", "--pairs", "8", "--workers", "1", "--out", str(tmp_path))
    assert "looks at 8 pairs" in said
    assert "aligned poses are wrong" in said
    assert said.count("confidence   pairs  right") == 1
    made, bundled = (json.loads(p.read_text()) for p in (tmp_path / "verdict.json", ROOT / "models" / "verdict.json"))
    assert {name: len(values) for name, values in made.items() if name != "made by"} == {
        name: len(values) for name, values in bundled.items() if name != "made by"
    }


def test_the_pairs_of_starts_are_turned_with_their_truth(room_scans: tuple) -> None:
    source, target, T = starts.turned(*room_scans, np.eye(4), np.random.default_rng(0))
    np.testing.assert_allclose(transform_points(T, source), room_scans[0], atol=1e-9)
    assert target is room_scans[1]


def test_where_the_default_s_pairs_come_from(room_scans: tuple) -> None:
    source, target = (scan[::4] for scan in room_scans)
    row = starts.where(iter([(source, target, np.eye(4))]))
    assert row["pairs"] == 1
    assert row["right"] == 1
    assert row["start"] in ("features 1", "rival 1", "search 1")
    assert 0 < row["IC"] < row["IC look"]  # type: ignore[operator]


@pytest.mark.slow
def test_starts_are_counted_on_a_folder(tmp_path: Path, room_scans: tuple) -> None:
    for name, scan in zip("ab", room_scans, strict=True):
        write_cloud(tmp_path / f"{name}.ply", PointCloud(scan))
        np.savetxt(tmp_path / f"{name}.pose.txt", np.eye(4))
    said = run("benchmarks.starts", "--data", str(tmp_path))
    rows = {line.split()[0]: line.split()[1:4] for line in said.splitlines()}
    assert rows["features"] == ["1", "1.000", "1.000"]
    assert "search" in rows


def test_a_loop_that_is_closed_half_a_metre_off_or_turned_is_a_wrong_one() -> None:
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, 0, 3] = [0, 5, 5, 0]
    assert drives.wrong_loops(truth, truth, [(0, 3), (1, 2)]) == 0
    shifted, turned = truth.copy(), truth.copy()
    shifted[3, 1, 3] = 0.6
    turned[2, :3, :3] = exp(np.radians([0, 0, 3.0, 0, 0, 0]))[:3, :3]
    assert drives.wrong_loops(shifted, truth, [(0, 3), (1, 2)]) == 1
    assert drives.wrong_loops(turned, truth, [(0, 3), (1, 2)]) == 1
