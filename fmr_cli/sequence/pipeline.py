"""The way of a sequence: scans in; a trajectory, a table of residuals and a map out, frame by frame, resumable.

begin (or go on) -> [read, thin -> register -> files] for each scan -> close loops -> files
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

import fmr_cli
from fmr_cli.cloud import PointCloud, angle_degrees
from fmr_cli.errors import CloudFileError, FmrError, RegistrationError
from fmr_cli.io import read_cloud
from fmr_cli.multiway.known import KnownPose
from fmr_cli.multiway.pose_graph import check_installed
from fmr_cli.registration.models import model
from fmr_cli.sequence.azimuth import Revolution, is_revolution, revolution
from fmr_cli.sequence.deskew import scan_times
from fmr_cli.sequence.frame import Frame
from fmr_cli.sequence.journal import Beginning, Journal
from fmr_cli.sequence.known_map import KnownMap
from fmr_cli.sequence.loader import Loader
from fmr_cli.sequence.loop_closure import close_loops
from fmr_cli.sequence.moving_scan import Within
from fmr_cli.sequence.odometry import Odometry
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.outputs import Outputs
from fmr_cli.sequence.prepared_scan import choose_voxel, prepare_scan
from fmr_cli.sequence.priors import Priors
from fmr_cli.sequence.readers import Readers, worth_a_process
from fmr_cli.sequence.result import SequenceResult
from fmr_cli.sequence.scans import Scans, as_scans
from fmr_cli.sequence.voxel_frame import VoxelFrame

VOXEL_SCANS = 5  # that the working voxel follows from: a first scan may stand in a narrow place, or before a wall

OnRow = Callable[[dict[str, Any], int, int], None]


def align_sequence(
    scans: Scans | str | Path | Iterable[str | Path | PointCloud], out: Path | None = None,
    options: SequenceOptions = SequenceOptions(), *, init_poses: Mapping[str, KnownPose] | None = None,
    known_map: Path | PointCloud | None = None, residuals: Path | None = None, merged: Path | None = None,
    resume: bool = False, on_row: OnRow | None = None,
) -> SequenceResult:  # fmt: skip
    """Register every scan into the frame of the first, or into a known map.

    scans: a folder, a KITTI sequence or drive, a text file that lists scans (see ``find_scans``), or files or clouds in
    their order. init_poses: poses known beforehand (T_world_scan) by scan, in any world of their own; the motions
    between them are what is expected, and followed along directions that scans don't observe. known_map: poses are then
    those in this map; the first scan is found in it by registration, or near its pose of ``init_poses``, whose world
    is the map's.
    out: the file of poses, written as they are made; a journal beside it lets ``resume`` go on after a kill, to the
    same poses. residuals: a CSV row a frame. merged: the map, a point a voxel. Nothing is written where no file is
    named. on_row: called with each new row, how many rows there are now, and of how many.
    Raises FmrError where the options ask for what the scans do not have, or a journal was begun otherwise;
    RegistrationError where the first scan cannot be used. A later scan that cannot be used is bridged.
    """
    scans = as_scans(scans)
    known_cloud = read_cloud(known_map, attributes=False) if isinstance(known_map, Path) else known_map
    check(scans, options, out, resume, known_cloud)
    journal = Journal(out, settings(scans, options, init_poses or {}, known_cloud))
    earlier = journal.read() if resume else None
    left = len(scans) - len(earlier[1] if earlier else [])
    with Readers(apart=worth_a_process(scans, left, keep_clouds=merged is not None)) as readers:
        beginning, done = earlier or (begin(scans, options, known_cloud), [])

        rows: list[dict[str, Any]] = []
        poses: list[np.ndarray] = []  # T_first_scan of every frame so far; the loader deskews by the last two
        loader = Loader(scans, beginning, poses, strict=options.deskew is True, keep_clouds=merged is not None)
        known = KnownMap((known_cloud.points - beginning.frame.of_map) / beginning.frame.voxel) if known_cloud else None
        odometry = Odometry(beginning.frame, known, options.pair)
        priors = Priors(scans, init_poses or {}, beginning.frame)
        go_on(done, rows, poses, loader, odometry)

        files = Outputs(
            scans, options, journal, out=out, residuals=residuals, merged=merged, voxel=beginning.frame.voxel
        )  # fmt: skip
        with files:
            files.begin(beginning, done, rows, poses, loader)
            for loaded in loader.ahead(len(rows), readers):
                if known and loaded.index == 0:
                    register = partial(odometry.begin_in_map, loaded.scan, priors.first())
                else:
                    told, pace = priors.motion(loaded.index), scans.pace(loaded.index)
                    register = partial(odometry.register, loaded.scan, told, pace, loaded.moving)
                frame, seconds = timed(register, scans.where(loaded.index))
                poses.append(frame.T_first_scan)
                moving = frame.moving or loaded.moving
                undone = {"deskewed_by": "azimuth" if beginning.revolution else "times"} if moving else {}
                rows.append(loaded.row | described(frame, poses) | undone | {"register_s": seconds})
                if moving:
                    loader.within[loaded.index] = moving.within
                state = {
                    "size": loaded.size, "T_map_scan": odometry.T_map_scan.tolist(),
                    "within": moving.within.to_json() if moving else None, "state": odometry.state(),
                }  # fmt: skip
                files.add(rows[-1], poses[-1], moving.still() if moving and merged else loaded.cloud, state)
                if on_row:
                    on_row(rows[-1], len(rows), len(scans))

            path, loops = np.stack(poses), tuple[tuple[int, int], ...]()
            if options.loop_closure:
                path, loops = close(path, rows, beginning.frame, loader, options)
            before = files.written(np.stack(poses)) if options.loop_closure else None
            result = SequenceResult(
                files.written(path), rows, beginning.frame.voxel, before, len(loops), out, loops, beginning.revolution
            )
            files.finish(result, path, loader)
        return result


def check(scans: Scans, options: SequenceOptions, out: Path | None, resume: bool, known_map: PointCloud | None) -> None:
    """Raises FmrError where the options ask for what is not there, before anything is read."""
    if options.camera_frame and scans.T_camera_scan is None:
        raise FmrError(f"{scans.where(0)}: no calib.txt with a line Tr beside it, leave out --camera-frame")
    if options.loop_closure and known_map:
        raise FmrError("--loop-closure: poses in a known map don't drift, leave out one of them")
    model(options.model)  # read before anything else is, so that a file that does not fit is said at once
    if options.loop_closure:
        check_installed("--loop-closure")
    if resume and (out is None or any(scans.path(i) is None for i in range(len(scans)))):
        raise FmrError("resume needs a file of poses, and scans in files; leave it out")


def settings(
    scans: Scans, options: SequenceOptions, init_poses: Mapping[str, KnownPose], known_map: PointCloud | None
) -> dict[str, Any]:
    """What must be the same in the run that is resumed."""
    told = [[k, p.T_world_scan.tolist(), p.sigma_rot_deg, p.sigma_shift] for k, p in init_poses.items()]
    return {
        "init_poses": sha256(repr(told).encode()).hexdigest() if told else None,
        "map": [str(known_map.path), len(known_map)] if known_map else None,
        "version": fmr_cli.__version__,
        "files": [scans.where(index) for index in range(len(scans))],
        "voxel_size": options.voxel_size,
        "deskew": options.deskew,
        "model": str(options.model) if options.model else None,
    }


def begin(scans: Scans, options: SequenceOptions, known_map: PointCloud | None) -> Beginning:
    """What follows from the first scan, and for deskewing from the first two. Raises CloudFileError."""
    try:
        cloud = scans.read(0, attributes=options.deskew is not False)
    except CloudFileError as error:
        raise CloudFileError(f"{error}; or leave this first scan out with --start") from None
    origin = np.median(cloud.points, axis=0)
    map_origin = np.median(known_map.points, axis=0) if known_map else origin
    frame = VoxelFrame(choose_voxel(cloud.points, options.voxel_size, some_later(scans)), origin, map_origin)
    deskewed, revolution = times_of(scans, cloud, frame, options.deskew)
    return Beginning(frame, first_motion(scans, frame, options) if deskewed else np.eye(4), deskewed, revolution)


def times_of(scans: Scans, first: PointCloud, frame: VoxelFrame, wanted: bool | None) -> tuple[bool, Revolution | None]:
    """Whether the motion within scans is to be undone, and by what where points have no times.

    wanted: None: where it can be. Raises CloudFileError where it is wanted and nothing tells when points were measured.
    """
    if wanted is False:
        return False, None
    try:
        scan_times(first)
        return True, None
    except CloudFileError as error:
        found = revolution(scans, frame) if is_revolution(first) else None
        if wanted and found is None:  # said before anything is written
            raise CloudFileError(f"{error}; nor does their azimuth show any motion within the scans") from None
        return found is not None, found


def some_later(scans: Scans) -> Iterator[np.ndarray]:
    """The points (N, 3) of a few scans over the whole sequence; those that cannot be read are bridged later on."""
    for index in sorted({len(scans) * part // VOXEL_SCANS for part in range(1, VOXEL_SCANS)} - {0}):
        with suppress(CloudFileError):
            yield scans.read(index, attributes=False).points


def first_motion(scans: Scans, frame: VoxelFrame, options: SequenceOptions) -> np.ndarray:
    """T_first_second (4, 4), file units, by the two scans as they are, which are skewed alike."""
    odometry = Odometry(replace(frame, map_origin=None), pair=options.pair)
    try:
        pair = [prepare_scan(scans.read(index, attributes=False).points, frame) for index in (0, 1)]
        _, second = [odometry.register(scan) for scan in pair]
    except (CloudFileError, RegistrationError):
        return np.eye(4)  # the run itself says what is wrong with them
    return second.T_first_scan if second.status == "aligned" else np.eye(4)


def go_on(
    done: list[dict[str, Any]], rows: list[dict[str, Any]], poses: list[np.ndarray], loader: Loader, odometry: Odometry
) -> None:
    """Put everything where it was after the frames that an earlier run has done; done: its lines of the journal."""
    if not done:
        return
    T_map_scan = [np.array(line["T_map_scan"]) for line in done]
    rows.extend(line["row"] for line in done)
    poses.extend(odometry.frame.pose_to_file(T) for T in T_map_scan)
    loader.within |= {i: Within.from_json(line["within"]) for i, line in enumerate(done) if line["within"]}
    loader.usual_sizes.extend(line["size"] for line in done if line["size"])
    odometry.restore(done[-1]["state"], T_map_scan, loader.scan)


def timed(register: Callable[[], Frame], name: str) -> tuple[Frame, float]:
    """The frame and the seconds it took. Raises RegistrationError with the scan's name."""
    start = time.perf_counter()
    try:
        return register(), round(time.perf_counter() - start, 4)
    except RegistrationError as error:
        raise RegistrationError(f"{name}: {error}") from None


def described(frame: Frame, poses: list[np.ndarray]) -> dict[str, Any]:
    """The frame's part of its row; poses: T_first_scan up to its own."""
    T_before_scan = np.linalg.inv(poses[-2] if len(poses) > 1 else poses[-1]) @ poses[-1]
    row: dict[str, Any] = {"status": frame.status, "start": frame.start, "overlap": round(frame.overlap, 4)}
    if math.isfinite(frame.inlier_rmse):
        row["inlier_rmse"] = six_digits(frame.inlier_rmse)
    if frame.feature_errors:
        row["feature_error_before"], row["feature_error_after"] = map(six_digits, frame.feature_errors)
    if frame.unobserved:
        row["unobserved"] = "; ".join(frame.unobserved)
        row["sigma_shift"], row["sigma_rotation_deg"] = map(six_digits, (frame.sigma_shift, frame.sigma_rotation))
    row["motion"] = six_digits(np.linalg.norm(T_before_scan[:3, 3]))
    row["rotation_deg"] = six_digits(angle_degrees(T_before_scan))
    return row


def six_digits(value: float | np.floating) -> float:
    return float(f"{value:.6g}")


def close(
    T_first_scan: np.ndarray,
    rows: list[dict[str, Any]],
    frame: VoxelFrame,
    loader: Loader,
    options: SequenceOptions,
) -> tuple[np.ndarray, tuple[tuple[int, int], ...]]:
    """The path (n, 4, 4) with its loops closed, and the frames that each of them joins."""
    sure = np.array([row["status"] == "aligned" for row in rows])
    closed, loops = close_loops(
        np.stack([frame.pose_to_voxels(T) for T in T_first_scan]), sure, loader.scan, options.pair
    )
    return np.stack([frame.pose_to_file(T_map_scan) for T_map_scan in closed]), tuple(
        (loop.earlier, loop.later) for loop in loops
    )
