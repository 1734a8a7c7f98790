"""`fmr sequence`: a trajectory, whatever the folder holds and whatever happens to the process."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulation import turn_and_shift

from fmr_cli import PointCloud, read_cloud, write_cloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.evaluation.truth import Truth
from fmr_cli.io import read_poses, write_poses

FRAMES = 8  # of the street's drive


def copy(street, tmp_path):
    folder = tmp_path / "scans"
    shutil.copytree(street[0], folder)
    return folder


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def whole(fmr, street, tmp_path_factory):
    """The folder of one run over the whole street: poses.txt, r.csv, map.ply."""
    out = tmp_path_factory.mktemp("whole")
    done = fmr(
        "sequence", street[0], "--out", out / "poses.txt", "--residuals", out / "r.csv", "--merged", out / "map.ply",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return out


def test_poses_residuals_and_map_of_a_moving_start(whole, street):
    poses = read_poses(whole / "poses.txt")
    assert np.abs(poses[:, :3, 3] - street[1][:, :3, 3]).max() < 0.03
    rows = table(whole / "r.csv")
    assert [row["file"] for row in rows] == [f"{i}.bin" for i in range(FRAMES)]
    assert all(row["status"] == "aligned" for row in rows)
    assert float(rows[3]["motion"]) == pytest.approx(0.4, abs=0.02)
    merged = read_cloud(whole / "map.ply")
    assert len(merged) < sum(int(row["points"]) for row in rows)
    assert np.array_equal(merged.attributes["frame"], merged.attributes["intensity"])
    assert not (whole / "poses.txt.journal").exists()


def test_natural_order_and_a_choice_of_scans_and_of_formats(fmr, street, tmp_path):
    folder = copy(street, tmp_path)
    (folder / "7.bin").rename(folder / "10.bin")
    write_cloud(folder / "extra.ply", read_cloud(folder / "0.bin"))
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    done = fmr(
        "sequence", folder, "--out", tmp_path / "p.json", "--format", "json", "--start", 2, "--step", 2,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [frame["file"] for frame in json.loads((tmp_path / "p.json").read_text())["frames"]] == [
        "2.bin", "4.bin", "6.bin",
    ]  # fmt: skip
    assert f"the {FRAMES} .bin files are taken, 1 .ply left out" in done.stderr


def test_kitti_folder_with_times_and_calibration(fmr, street, whole, tmp_path):
    root = tmp_path / "00"
    shutil.copytree(street[0], root / "velodyne")
    Tr = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]])
    (root / "calib.txt").write_text("P0: 1 2 3\nTr: " + " ".join(map(str, Tr.ravel())) + "\n")
    (root / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(FRAMES)))
    assert fmr("sequence", root, "--out", tmp_path / "c.txt", "--stop", 3, "--camera-frame").returncode == 0
    assert fmr("sequence", root, "--out", tmp_path / "t.txt", "--stop", 3, "--format", "tum").returncode == 0
    T = np.vstack([Tr, [0, 0, 0, 1]])
    expected = T @ read_poses(whole / "poses.txt")[:3] @ np.linalg.inv(T)
    assert np.allclose(read_poses(tmp_path / "c.txt"), expected, atol=1e-12)
    tum = np.loadtxt(tmp_path / "t.txt")
    assert np.allclose(tum[:, 0], [0, 0.1, 0.2])
    assert np.allclose(tum[:, 1:4], read_poses(whole / "poses.txt")[:3, :3, 3])


def test_a_list_of_scans(fmr, street, tmp_path):
    (tmp_path / "scans.txt").write_text("".join(f"{street[0] / f'{i}.bin'}\n" for i in (0, 1)))
    assert fmr("sequence", tmp_path / "scans.txt", "--out", tmp_path / "p.txt").returncode == 0
    assert len(read_poses(tmp_path / "p.txt")) == 2


def test_bad_scans_are_bridged_and_named_and_points_that_are_not_finite_left_out(fmr, street, tmp_path):
    """Truncated, empty, in another unit; of the scan between them a fiftieth has no coordinates."""
    folder, truth = copy(street, tmp_path), street[1]
    (folder / "2.bin").write_bytes((folder / "2.bin").read_bytes()[:1001])
    (folder / "4.bin").write_bytes(b"")
    write_cloud(folder / "6.bin", PointCloud(read_cloud(folder / "6.bin").points * 1000))
    rows = np.fromfile(folder / "3.bin", np.float32).reshape(-1, 4)
    rows[::50, 1] = np.nan
    rows.tofile(folder / "3.bin")
    done = fmr("sequence", folder, "--out", tmp_path / "p.txt", "--residuals", tmp_path / "r.csv")
    assert done.returncode == 3
    assert "3 uncertain, look at: 2 (2.bin), 4 (4.bin), 6 (6.bin)" in done.stderr
    for frame in (2, 4, 6):
        assert f"frame {frame} is bridged" in done.stderr
    uncertain = [row["frame"] for row in table(tmp_path / "r.csv") if row["status"] == "uncertain"]
    assert uncertain == ["2", "4", "6"]
    poses = read_poses(tmp_path / "p.txt")
    assert np.abs(poses[:, :3, 3] - truth[:, :3, 3]).max() < 0.05


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda folder: None, "holds no scans"),
        (lambda folder: (folder / "a.bin").write_bytes(b"0" * 1600), "one scan only"),
    ],
)
def test_too_few_scans_are_one_line(fmr, tmp_path, make, says):
    (tmp_path / "scans").mkdir()
    make(tmp_path / "scans")
    done = fmr("sequence", tmp_path / "scans", "--out", tmp_path / "p.txt")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert not (tmp_path / "p.txt").exists()


def test_camera_frame_without_calibration_is_one_line(fmr, street, tmp_path):
    done = fmr("sequence", street[0], "--out", tmp_path / "p.txt", "--camera-frame")
    assert done.returncode == 2
    assert "no calib.txt" in done.stderr


def test_killed_and_resumed_it_comes_to_the_same_poses(fmr, street, whole, tmp_path):
    folder = street[0]
    out, residuals = tmp_path / "p.txt", tmp_path / "r.csv"
    command = [sys.executable, "-m", "fmr_cli.cli", "sequence", folder, "--out", out, "--residuals", residuals]
    process = subprocess.Popen([str(part) for part in command], stderr=subprocess.DEVNULL)
    while process.poll() is None and not (out.exists() and out.read_text().count("\n") >= 3):
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert 3 <= out.read_text().count("\n") < FRAMES
    other = fmr("sequence", folder, "--out", out, "--residuals", residuals, "--resume", "--voxel-size", 1)
    assert other.returncode == 2
    assert "voxel_size" in other.stderr
    assert fmr("sequence", folder, "--out", out, "--residuals", residuals, "--resume").returncode == 0
    assert np.abs(read_poses(out) - read_poses(whole / "poses.txt")).max() < 1e-9
    assert [row["frame"] for row in table(residuals)] == [str(i) for i in range(FRAMES)]


def test_errors_against_the_truth_and_a_picture(fmr, street, tmp_path):
    pytest.importorskip("evo")
    folder, truth = street
    write_poses(tmp_path / "truth.txt", truth)
    done = fmr("sequence", folder, "--out", tmp_path / "p.txt", "--truth", tmp_path / "truth.txt", "--step", 2)
    assert done.returncode == 0, done.stderr
    errors = json.loads((tmp_path / "p.evaluation.json").read_text())
    assert errors["frames"] == FRAMES // 2
    assert errors["ape_rmse_first_pose"] < 0.03
    assert "end drift" in done.stderr
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_of_scans_with_times_against_tum_of_fewer_poses(fmr, street, tmp_path):
    """Scans at 10 Hz, named by their times; true poses between them, at 4 Hz, for the first half second alone."""
    pytest.importorskip("evo")
    folder = tmp_path / "scans"
    folder.mkdir()
    for i in range(FRAMES):
        (folder / f"{50 + i / 10:.1f}.bin").write_bytes((street[0] / f"{i}.bin").read_bytes())
    at = np.array([0.5, 3.0, 5.5])  # frames
    true = Truth(street[1][:3], at).beside(street[1])
    rows = np.column_stack([50 + at / 10, true[:, :3, 3], Rotation.from_matrix(true[:, :3, :3]).as_quat()])
    np.savetxt(tmp_path / "truth.tum", rows, fmt="%.6f")
    done = fmr("sequence", folder, "--out", tmp_path / "p.tum", "--format", "tum", "--truth", tmp_path / "truth.tum",
               "--picture", tmp_path / "seen.svg")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"3 true poses among {FRAMES} frames" in done.stderr
    errors = json.loads((tmp_path / "p.evaluation.json").read_text())
    assert errors["frames"] == 3
    assert errors["ape_rmse_first_pose"] < 0.03
    assert "error by length" in (tmp_path / "seen.svg").read_text("utf-8")
    assert not (tmp_path / "p.png").exists()


def test_a_picture_without_truth(fmr, street, tmp_path):
    pytest.importorskip("matplotlib")
    options = ("--stop", 3, "--picture", tmp_path / "seen.svg")
    done = fmr("sequence", street[0], "--out", tmp_path / "p.txt", *options)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "seen.svg").read_text("utf-8")
    assert "path over the map" in text
    assert "error by length" not in text
    done = fmr("sequence", street[0], "--out", tmp_path / "q.txt", "--picture", tmp_path / "seen.jpg")
    assert done.returncode == 2
    assert "cannot write the suffix '.jpg'" in done.stderr
    assert not (tmp_path / "q.txt").exists()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("\n".join(3 * ["1 0 0 0 0 1 0 0 0 0 1 0"]), f"3 poses for {FRAMES} scans, give a row for each scan"),
        ("\n".join(3 * ["1 2 3 4 5 6 7"]), "has 7 numbers a line; KITTI has 12, TUM 8"),
    ],
)
def test_what_is_no_truth_of_these_scans_is_one_line(fmr, street, tmp_path, content, says):
    pytest.importorskip("evo")
    (tmp_path / "truth.txt").write_text(content)
    done = fmr("sequence", street[0], "--out", tmp_path / "p.txt", "--truth", tmp_path / "truth.txt")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert not (tmp_path / "p.txt").exists()


def test_deskew_undoes_the_motion_within_the_scans(fmr, moving, tmp_path):
    folder, truth = moving
    end_errors = []
    for options in (["--no-deskew"], []):
        done = fmr("sequence", folder, "--out", tmp_path / "p.txt", "--stop", 10, *options)
        assert done.returncode == 0, done.stderr
        error = np.linalg.inv(read_poses(tmp_path / "p.txt")) @ truth[:10]
        end_errors.append([np.linalg.norm(error[-1, :3, 3]), angle_degrees(error[-1])])
    (shift, angle), (shift_deskewed, angle_deskewed) = end_errors
    assert shift_deskewed < min(0.06, shift / 3)
    assert angle_deskewed < min(0.15, angle / 5)


def test_deskew_of_scans_without_times_is_one_line(fmr, street, tmp_path):
    done = fmr("sequence", street[0], "--out", tmp_path / "p.txt", "--deskew")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "0.bin: has no time per point (fields gps_time, time, timestamp, t, " in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_priors_and_a_known_map(fmr, street, tmp_path):
    """The drive's second half, named by its times, in the map of its first; one first pose is told, roughly."""
    scans, truth = [read_cloud(street[0] / f"{i}.bin") for i in range(FRAMES)], street[1]
    first = [scan.transformed(T).points for scan, T in zip(scans[:5], truth, strict=False)]
    write_cloud(tmp_path / "known.las", PointCloud(np.concatenate(first)))
    folder = tmp_path / "scans"
    folder.mkdir()
    for i in (4, 5, 6):
        write_cloud(folder / f"{100 + i / 20:.2f}.ply", scans[i])
    rough = " ".join(f"{x:.12g}" for x in (truth[4] @ turn_and_shift(2.0, 0.4))[:3].ravel())
    (tmp_path / "told.csv").write_text(f"scan,pose,sigma_shift\n100.20,{rough},0.5\n")
    done = fmr(
        "sequence", folder, "--out", tmp_path / "p.tum", "--map", tmp_path / "known.las",
        "--init-poses", tmp_path / "told.csv", "--format", "tum",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = np.loadtxt(tmp_path / "p.tum")
    assert np.allclose(rows[:, 0], [100.2, 100.25, 100.3])
    assert np.abs(rows[:, 1:4] - truth[4:7, :3, 3]).max() < 0.05
    done = fmr("sequence", folder, "--out", tmp_path / "q.txt", "--map", tmp_path / "known.las", "--loop-closure")
    assert done.returncode == 2
    assert "poses in a known map don't drift" in done.stderr
