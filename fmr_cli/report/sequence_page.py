"""The report of ``fmr sequence``: the path over the map, how sure each frame is, and which frames to look at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.errors import FmrError
from fmr_cli.registration.result import plain, versions
from fmr_cli.report.networks import column, number_of
from fmr_cli.report.page import write_page
from fmr_cli.report.points import SOURCE, TARGET, broad_side, ground, picture, shown
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.result import SequenceResult
from fmr_cli.sequence.scans import Scans

MAP_FRAMES, MAP_POINTS = 80, 6_000  # frames that the map behind the path is made of, and points of each
BEFORE = 3  # frames that a frame is shown against
LOOK_AT = 18  # frames with their pictures
ROWS = 5_000  # of the table; of longer sequences the uncertain ones and an even choice
COLUMNS = (
    column("status", "Status", "status"), column("frame", "Frame"), column("file", "File", "name"),
    column("start", "Start", "name"), column("overlap", "Overlap", "share"), column("inlier_rmse", "Residual"),
    column("motion", "Motion"), column("rotation_deg", "Rotation °"), column("sigma_shift", "Sigma, shift"),
    column("sigma_rotation_deg", "Sigma, rotation °"), column("register_s", "Seconds"),
    column("words", "Not observed; message", "words"),
)  # fmt: skip

Read = Callable[[int], np.ndarray]


def write_sequence(path: Path, result: SequenceResult, scans: Scans, options: SequenceOptions) -> None:
    """The report of a sequence as one HTML file; scans: those it was made of."""
    T_first_scan = in_scanner_frame(result, scans, options)
    before = None if result.odometry_poses is None else in_scanner_frame(result, scans, options, odometry=True)
    read = reader(scans)
    seen = map_points(T_first_scan, read)
    count = Counter(row["status"] for row in result.rows)
    length = sum(row["motion"] for row in result.rows)
    residuals = [row["inlier_rmse"] for row in result.rows[1:] if "inlier_rmse" in row]
    write_page(
        path, "sequence.html", path_data(result, T_first_scan, before, seen), ("sequence.js",),
        title=f"Sequence of {len(result.rows)} scans", status=result.status, words=result.summary(), figures=[
            (str(count["aligned"]), "frames aligned"), (str(count["uncertain"]), "frames uncertain"),
            (f"{length:.4g}", "length of the path"), (f"{result.voxel_size:.3g}", "working voxel edge"),
            (f"{np.median(residuals):.3g}" if residuals else "\u2013", "residual, median"),
            (str(result.loops) if before is not None else "not asked for", "loops closed"),
        ],
        rows=table_rows(result.rows), columns=COLUMNS, statuses=[s for s in ("uncertain", "aligned") if count[s]],
        frames=frames_to_look_at(result.rows, T_first_scan, read), settings=plain(asdict(options)),
        versions=versions(), loops=before is not None,
    )  # fmt: skip


def in_scanner_frame(
    result: SequenceResult, scans: Scans, options: SequenceOptions, odometry: bool = False
) -> np.ndarray:
    """(n, 4, 4): the poses of the scans, also where those of the camera were asked for."""
    poses = result.odometry_poses if odometry else result.poses
    assert poses is not None
    return of_scanner(poses, scans, options)


def of_scanner(poses: np.ndarray, scans: Scans, options: SequenceOptions) -> np.ndarray:
    """Poses (n, 4, 4) of what the options ask for, the scanner or the camera, as the scanner's."""
    T = scans.T_camera_scan if options.camera_frame else None
    return poses if T is None else np.linalg.inv(T) @ poses @ T


def reader(scans: Scans) -> Read:
    """Gives some points of a frame; none where it cannot be read: the run has said so."""

    def read(index: int) -> np.ndarray:
        try:
            return shown(scans.read(index, attributes=False).points, MAP_POINTS)
        except FmrError:
            return np.zeros((0, 3))

    return read


def map_points(T_first_scan: np.ndarray, read: Read) -> np.ndarray:
    """The points of an even choice of frames, in the first one's."""
    chosen = np.unique(np.linspace(0, len(T_first_scan) - 1, MAP_FRAMES).round().astype(int))
    return np.concatenate([transform_points(T_first_scan[i], read(i)) for i in chosen])


def above(seen: np.ndarray, centres: np.ndarray) -> tuple[list[int], int]:
    """The two axes of the view of a path (n, 3) over the map (N, 3) from where both are broadest, and the third."""
    axes = list(broad_side(np.concatenate([seen, centres])).axes)
    return axes, next(a for a in range(3) if a not in axes)


def box_about(seen: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """(2, 2): low and high about a path (n, 2) and all but the outermost points (N, 2) of the map, with a margin."""
    low, high = np.quantile(np.concatenate([seen, centres]), [0.01, 0.99], axis=0)
    low, high = np.minimum(low, centres.min(0)), np.maximum(high, centres.max(0))
    margin = 0.03 * float((high - low).max()) or 1.0  # one place alone has no size
    return np.stack([low - margin, high + margin])


def path_data(
    result: SequenceResult, T_first_scan: np.ndarray, before: np.ndarray | None, seen: np.ndarray
) -> dict[str, Any]:
    """What the page's scripts draw. The side view looks along the shorter side of the path seen from above."""
    centres = T_first_scan[:, :3, 3]
    axes, up = above(seen, centres)
    along = axes[int(np.argmax(np.ptp(centres[:, axes], axis=0)))]
    names = ("frame", "status", "file", "inlier_rmse", "sigma_shift", "sigma_rotation_deg", "overlap", "unobserved")
    views = []
    for name, pair in (("above" if up == 2 else f"along {'xyz'[up]}", axes), ("side", [along, up])):
        box = box_about(seen[:, pair], centres[:, pair])
        views.append({
            "name": name, "axes": ["xyz"[a] for a in pair], "box": box.tolist(), "xy": centres[:, pair].tolist(),
            "before": None if before is None else before[:, :3, 3][:, pair].tolist(),
            "ground": ground(seen[:, pair], box),
        })  # fmt: skip
    return plain({
        "views": views, "rows": [{name: row.get(name) for name in names} for row in result.rows],
        "loops": [list(pair) for pair in result.closed], "voxel": result.voxel_size,
    })  # fmt: skip


def table_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The frames of the table."""
    every = -(-len(rows) // ROWS)
    kept = [row for n, row in enumerate(rows) if n % every == 0 or row["status"] != "aligned"]
    numbers = [c["key"] for c in COLUMNS if c["kind"] in ("number", "share")]
    return [
        {name: number_of(row.get(name)) for name in numbers}
        | {"id": f"frame-{row['frame']}", "frame": row["frame"], "status": row["status"], "file": row.get("file", ""),
           "start": row.get("start", ""),
           "words": "; ".join(str(row[name]) for name in ("unobserved", "message") if row.get(name))}
        for row in kept
    ]  # fmt: skip


def frames_to_look_at(rows: Sequence[dict[str, Any]], T_first_scan: np.ndarray, read: Read) -> list[dict[str, Any]]:
    """The uncertain frames, else those of the largest residuals, each with its picture against the frames before it.

    An even choice of the uncertain ones where they are many.
    """
    uncertain = [n for n, row in enumerate(rows) if row["status"] != "aligned"]
    by_residual = sorted(range(1, len(rows)), key=lambda n: -(rows[n].get("inlier_rmse") or 0.0))
    some = uncertain or by_residual[: LOOK_AT // 3]
    chosen = sorted({some[int(i)] for i in np.linspace(0, len(some) - 1, min(LOOK_AT, len(some))).round()})
    frames = []
    for n in chosen:
        own = read(n)
        others = [transform_points(T_first_scan[k], read(k)) for k in range(max(n - BEFORE, 0), n)]
        place = np.concatenate(others) if others else np.zeros((0, 3))
        seen = ""
        if len(own) and len(place):
            moved = transform_points(T_first_scan[n], own)
            seen = picture([(place, TARGET), (moved, SOURCE)], broad_side(moved))
        row = rows[n]
        said = [row.get("unobserved") and f"{row['unobserved']} not observed", row.get("message")]
        frames.append({
            "frame": row["frame"], "file": row.get("file", ""), "status": row["status"], "picture": seen,
            "words": "; ".join(x for x in said if x) or f"residual {number_of(row.get('inlier_rmse')) or 0:.3g}",
        })  # fmt: skip
    return frames
