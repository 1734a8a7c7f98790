"""Small data sets in the layouts of the field, written from scans of one made-up room or street with exact truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rooms import room_views

from fmr_cli import PointCloud, write_cloud
from fmr_cli.evaluation.datasets.pair import information
from fmr_cli.io import write_transform


def block(head: tuple, matrix: np.ndarray) -> str:
    """A pair of gt.log or gt.info."""
    return "\t".join(map(str, head)) + "\n" + "".join("\t".join(f"{v:.12f}" for v in row) + "\n" for row in matrix)


def three_fragments() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Three scans (n, 3) of a room, m, each in its own frame, and T_world_scan."""
    return room_views(5, 3, 4_000)


def write_3dmatch(root: Path, name: str = "7-scenes-redkitchen") -> dict[tuple[int, int], np.ndarray]:
    """SCENE/cloud_bin_I.ply and SCENE-evaluation/gt.log, gt.info; the truths by (target, source)."""
    clouds, poses = three_fragments()
    (root / name).mkdir(parents=True)
    evaluation = root / f"{name}-evaluation"
    evaluation.mkdir()
    truths, log, info = {}, "", ""
    for number, cloud in enumerate(clouds):
        write_cloud(root / name / f"cloud_bin_{number}.ply", PointCloud(cloud))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        truths[i, j] = np.linalg.inv(poses[i]) @ poses[j]
        log += block((i, j, 3), truths[i, j])
        info += block((i, j, 3), information(clouds[j][::50]))
    (evaluation / "gt.log").write_text(log)
    (evaluation / "gt.info").write_text(info)
    return truths


def write_eth(root: Path, name: str = "gazebo_summer", overlap: np.ndarray | None = None) -> None:
    clouds, poses = three_fragments()
    (root / name).mkdir(parents=True)
    log = ""
    for number, cloud in enumerate(clouds):
        write_cloud(root / name / f"Hokuyo_{number}.ply", PointCloud(cloud))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        log += block((i, j, 3), np.linalg.inv(poses[i]) @ poses[j])
    (root / name / "gt.log").write_text(log)
    if overlap is not None:
        np.savetxt(root / name / "overlapMatrix.csv", overlap, delimiter=",")


TR = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])  # scanner to camera, as KITTI's


def write_kitti(root: Path, scans: list[np.ndarray], poses: np.ndarray, name: str = "08") -> None:
    """sequences/NAME/velodyne/000000.bin ..., calib.txt, poses/NAME.txt of the camera. poses: T_world_scan."""
    folder = root / "sequences" / name / "velodyne"
    folder.mkdir(parents=True)
    (root / "poses").mkdir(exist_ok=True)
    for number, scan in enumerate(scans):
        write_cloud(folder / f"{number:06d}.bin", PointCloud(scan, {"intensity": np.full(len(scan), 0.5, np.float32)}))
    rows = [TR @ pose @ np.linalg.inv(TR) for pose in poses]
    (root / "poses" / f"{name}.txt").write_text(
        "".join(" ".join(f"{v:.9e}" for v in T[:3].ravel()) + "\n" for T in rows)
    )
    calibration = " ".join(f"{v:.9e}" for v in TR[:3].ravel())
    (root / "sequences" / name / "calib.txt").write_text(f"P0: {' '.join(['0'] * 12)}\nTr: {calibration}\n")


def write_poses(root: Path, several: bool = True) -> None:
    """A folder of three scans with NAME.pose.txt beside each, or one poses.txt."""
    clouds, poses = three_fragments()
    root.mkdir(parents=True)
    for number, (cloud, T) in enumerate(zip(clouds, poses, strict=True)):
        write_cloud(root / f"scan{number + 8}.ply", PointCloud(cloud))  # scan8, scan9, scan10: natural order matters
        if several:
            write_transform(root / f"scan{number + 8}.pose.txt", T)
    if not several:
        rows = [" ".join(f"{v:.17g}" for v in T[:3].ravel()) for T in poses]
        (root / "poses.txt").write_text("\n".join(rows) + "\n")


CUBE = """OFF
8 12 0
-1 -1 -1
1 -1 -1
1 1 -1
-1 1 -1
-1 -1 1
1 -1 1
1 1 1
-1 1 3
3 0 1 2
3 0 2 3
3 4 5 6
3 4 6 7
3 0 1 5
3 0 5 4
3 1 2 6
3 1 6 5
3 2 3 7
3 2 7 6
3 3 0 4
3 3 4 7
"""  # a box with one corner drawn out, so that no turn maps it onto itself


def write_modelnet(root: Path) -> None:
    for category in ("airplane", "xbox"):
        (root / category / "test").mkdir(parents=True)
        (root / category / "test" / f"{category}_0001.off").write_text(CUBE)
