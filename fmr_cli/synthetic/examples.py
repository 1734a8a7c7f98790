"""Example scans with their truth, to try things on: two scans of a room, a building, a drive along a street; metres.

Each writes a folder that the commands take as it is, and that `fmr evaluate` recognises.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.io import write_cloud, write_poses, write_transform
from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.building import building, terrestrial
from fmr_cli.synthetic.sensors import terrestrial_scan

NOISE = 0.003  # m, of the room's scans
STEP = 1.0  # m between the scans of the drive: 36 km/h at 10 Hz
LENGTH = 160.0  # m of street: more than a drive may be long
BEAMS, COLUMNS, REACH = 32, 720, 60.0  # of the drive's scanner; m


def write_pair(folder: Path, scans: int, seed: int) -> list[Path]:
    """scan_a.ply, scan_b.ply of a furnished room, each in a frame of its own; truth.txt, T_scan_b_scan_a; pairs.csv.

    pairs.csv: each scan onto the next one, with the truth.
    """
    rng = np.random.default_rng(seed)
    room, written, truth = scenes.room(rng), [], []
    for number in range(scans):
        eye = np.array([0.7 * np.cos(number), 0.7 * np.sin(number), 1.5])
        points = terrestrial_scan(room, rng, eye, 20.0, columns=240).points
        points = points + rng.normal(0, NOISE, points.shape)
        T_scan_world = own_frame(eye, rng)
        written.append(folder / f"scan_{chr(ord('a') + number)}.ply")
        write_cloud(written[-1], PointCloud(transform_points(T_scan_world, points)))
        truth.append(T_scan_world)
    lines = ["source,target,transform"]
    for number in range(scans - 1):
        T = truth[number + 1] @ np.linalg.inv(truth[number])
        words = " ".join(f"{value:.17g}" for value in T[:3].ravel())
        lines.append(f"{written[number].name},{written[number + 1].name},{words}")
    (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
    write_transform(folder / "truth.txt", truth[1] @ np.linalg.inv(truth[0]))
    return written


def write_building(folder: Path, scans: int, seed: int) -> list[Path]:
    """office_00.ply, ... of a building whose rooms resemble each other, and NAME.pose.txt, scan to world, beside each.

    In the order of a walk: along the corridors, into the rooms on either side.
    """
    rng = np.random.default_rng(seed)
    scene, eyes = building(rng)
    written = []
    for number, eye in enumerate(along_a_walk(eyes)[:scans]):
        points = terrestrial(scene, eye, rng, columns=300)
        T_scan_world = own_frame(eye, rng)
        written.append(folder / f"office_{number:02d}.ply")
        write_cloud(written[-1], PointCloud(transform_points(T_scan_world, points)))
        write_transform(written[-1].with_suffix(".pose.txt"), np.linalg.inv(T_scan_world))
    return written


def along_a_walk(eyes: list[np.ndarray]) -> list[np.ndarray]:
    """The places, each next to the nearest one before: what is scanned first hangs together."""
    left, order = [*eyes[1:]], [eyes[0]]
    while left:
        apart = [min(np.linalg.norm(eye - other) for other in order) for eye in left]
        order.append(left.pop(int(np.argmin(apart))))
    return order


def write_drive(folder: Path, scans: int, seed: int) -> list[Path]:
    """A drive along a street as KITTI lays it out: velodyne/000000.bin, ..., calib.txt (identity), times, poses."""
    rng = np.random.default_rng(seed)
    street = scenes.street(rng, LENGTH)
    (folder / "velodyne").mkdir(exist_ok=True)
    poses, written = [], []
    for number in range(scans):
        s = number * STEP - LENGTH / 4
        turn = Rotation.from_euler("z", 0.15 * np.cos(s / 12))
        eye = np.array([s, 1.5 * np.sin(s / 12), 1.8])
        points = scenes.scan(street, eye, scenes.lidar_rays(turn, BEAMS, COLUMNS), rng, 0.0005, REACH)
        T_world_scan = np.eye(4)
        T_world_scan[:3, :3], T_world_scan[:3, 3] = turn.as_matrix(), eye
        poses.append(T_world_scan)
        points = transform_points(np.linalg.inv(T_world_scan), points)
        written.append(folder / "velodyne" / f"{number:06d}.bin")
        write_cloud(written[-1], PointCloud(points, {"intensity": np.full(len(points), 0.5, np.float32)}))
    write_poses(folder / "poses.txt", np.linalg.inv(poses[0]) @ np.stack(poses))
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * number:.1f}\n" for number in range(scans)))
    return written


def own_frame(eye: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """T_scan_world (4, 4) of a scanner at eye (3,): the origin at the scanner, the axes turned at random."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = -T[:3, :3] @ eye
    return T


# name -> (what writes it, scans if not said, scans at most)
EXAMPLES: dict[str, tuple[Callable[[Path, int, int], list[Path]], int, int]] = {
    "pair": (write_pair, 2, 26),
    "building": (write_building, 20, 40),
    "drive": (write_drive, 60, 120),
}
