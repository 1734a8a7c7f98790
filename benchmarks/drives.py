"""Made-up drives with exact truth: drift, frames lost, loops, seconds; KISS-ICP beside it.

    python -m benchmarks.drives --out /tmp/drives                     # all of them
    python -m benchmarks.drives street64 mine16 --frames 60 --out /tmp/drives

Scans are made once per --out and kept there. A step (one frame to the next) is wrong where it is more than 0.1 m and a
twentieth of its length off, or 2 deg; "silent" counts those of frames that are called aligned. A loop is wrong where
its two frames are more than half a metre, or 2 deg, off each other on the closed path.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from fmr_cli import PointCloud, read_cloud, write_cloud
from fmr_cli.evaluation.trajectory import segment_errors
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.io import read_poses, write_poses
from fmr_cli.sequence import SequenceOptions, align_sequence
from fmr_cli.synthetic.drives import (
    Drive,
    Sensor,
    Way,
    campus,
    depth_camera,
    passages,
    solid_state,
    spinning,
    streets,
    warehouse,
)

WRONG_SHIFT, WRONG_SHARE, WRONG_DEGREES = 0.1, 0.05, 2.0  # m, of the step, deg
WRONG_LOOP = 0.5  # m that a loop's two frames may be off each other once it is closed
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)  # of the path: the segments' lengths


def drive(place: Callable, size: tuple, sensor: Sensor, speed: float, rate: float, laps: float, **way: float) -> Drive:
    rng = np.random.default_rng(0)
    scene, corners = place(rng, *size)
    return Drive(scene, Way(corners, speed, **way), sensor, rate, laps)


def drives() -> dict[str, Drive]:
    """Places and scanners; "skewed": the scanner moves while it scans, and the points' times are there."""
    hdl64, vlp16 = spinning(64, -24.8, 2.0, 900), spinning(16, -15, 15, 900, 60.0)
    hdl32 = spinning(32, -30, 10, 900, 60.0, sweep=0.1)
    vlp16_skewed = spinning(16, -15, 15, 900, 60.0, sweep=0.1)
    return {
        "street64": drive(streets, (220, 120), hdl64, 10.0, 10.0, 1.1),
        "street32, skewed": drive(streets, (160, 100), hdl32, 10.0, 10.0, 1.1),
        "street16": drive(streets, (120, 80), vlp16, 6.0, 5.0, 1.1),
        "campus32, skewed": drive(campus, (120, 80), hdl32, 3.0, 2.0, 1.1, wobble=3.0),
        "shaken16, skewed": drive(streets, (80, 60), vlp16_skewed, 0.5, 10.0, 1.1, wobble=12.0),
        "campus64": drive(campus, (160, 100), hdl64, 8.0, 10.0, 1.1),
        "building16": drive(passages, (36, 24, 2.4, 0.0), vlp16, 1.2, 5.0, 1.1, wobble=1.0),
        "building, depth camera": drive(passages, (24, 16, 2.4, 0.0), depth_camera(), 0.8, 10.0, 1.1),
        "mine16": drive(passages, (80, 50, 5.0, 0.8), vlp16, 3.0, 10.0, 1.1),
        "warehouse32": drive(warehouse, (60, 30), spinning(32, -30, 10, 900, 40.0), 1.5, 5.0, 1.0, closed=False),
        "street, solid state": drive(streets, (120, 80), solid_state(), 6.0, 10.0, 1.1),
    }


def made(name: str, drive: Drive, out: Path, frames: int | None) -> tuple[list[Path], np.ndarray]:
    """The scans' files and their true poses (n, 4, 4)."""
    folder = out / name.replace(", ", "_").replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    truth = drive.truth()[:frames]
    files = [folder / f"{i:06d}.ply" for i in range(len(truth))]
    if not all(file.exists() for file in files):
        for file, cloud in zip(files, drive.scans(), strict=False):
            write_cloud(file, cloud)
    write_poses(folder / "truth.txt", truth)
    return files, read_poses(folder / "truth.txt")


def kiss_icp(files: list[Path], reach: float) -> np.ndarray:
    """The poses (n, 4, 4) that KISS-ICP gives, as its own pipeline does it."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.max_range, config.data.min_range = reach, 0.0
    config.mapping.voxel_size = reach / 100
    odometry, poses = KissICP(config), []
    for file in files:
        cloud = read_cloud(file)
        times = cloud.attributes["time"]
        spread = np.ptp(times)
        config.data.deskew = bool(spread > 0)
        odometry.register_frame(cloud.points, (times - times.min()) / spread if spread > 0 else np.zeros(0))
        poses.append(odometry.last_pose.copy())
    return np.array(poses)


def errors(poses: np.ndarray, truth: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Drift over segments and at the end, percent; and which steps are wrong (n - 1,)."""
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    length = steps.sum()
    drift = segment_errors(poses, truth, [share * length for share in SHARES], 5).means()[0]
    found, true = (np.linalg.inv(path[:-1]) @ path[1:] for path in (poses, truth))
    degrees, shift = pose_error(found, true)
    wrong = (shift > WRONG_SHIFT + WRONG_SHARE * steps) | (degrees > WRONG_DEGREES)
    end = np.linalg.norm((np.linalg.inv(poses[0]) @ poses[-1])[:3, 3] - truth[-1][:3, 3])
    return drift, float(100 * end / length), wrong


def wrong_loops(poses: np.ndarray, truth: np.ndarray, closed: Iterable[tuple[int, int]]) -> int:
    """How many of the loops, pairs of frames, a path has closed wrongly."""
    wrong = 0
    for earlier, later in closed:
        found, true = (np.linalg.inv(path[earlier]) @ path[later] for path in (poses, truth))
        degrees, shift = pose_error(found, true)
        wrong += bool(shift > WRONG_LOOP or degrees > WRONG_DEGREES)
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="drives, all if none is named")
    parser.add_argument("--frames", type=int, help="the first so many of each alone")
    parser.add_argument("--loops", action="store_true", help="close loops")
    parser.add_argument("--voxel-size", type=float)
    parser.add_argument("--no-times", action="store_true", help="fmr has points without their times")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    table = Table(
        "drive", "method", "frames", "m", "drift %", "end %", "uncertain", "wrong", "silent", "loops", "loops wrong",
        "s/frame",
    )  # fmt: skip
    for name, each in drives().items():
        if args.names and name.split(",")[0] not in args.names and name not in args.names:
            continue
        files, truth = made(name, each, args.out, args.frames)
        scans = [PointCloud(read_cloud(file).points) for file in files] if args.no_times else files
        start = time.perf_counter()
        result = align_sequence(
            scans, None, SequenceOptions(loop_closure=args.loops, voxel_size=args.voxel_size)
        )  # fmt: skip
        seconds = (time.perf_counter() - start) / len(files)
        length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
        drift, end, wrong = errors(result.poses, truth)
        sure = np.array([row["status"] == "aligned" for row in result.rows])
        silent = wrong & sure[1:] & sure[:-1]
        table.add_row(
            name, "fmr", str(len(files)), f"{length:.0f}", f"{drift:.3f}", f"{end:.3f}", str((~sure).sum()),
            str(wrong.sum()), str(silent.sum()),
            *([str(result.loops), str(wrong_loops(result.poses, truth, result.closed))] if args.loops else ["", ""]),
            f"{seconds:.3f}",
        )  # fmt: skip
        if not args.no_peers:
            start = time.perf_counter()
            poses = kiss_icp(files, each.sensor.reach)
            seconds = (time.perf_counter() - start) / len(files)
            drift, end, wrong = errors(poses, truth)
            table.add_row(
                "", "KISS-ICP", "", "", f"{drift:.3f}", f"{end:.3f}", "", str(wrong.sum()), "", "", "", f"{seconds:.3f}"
            )
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
