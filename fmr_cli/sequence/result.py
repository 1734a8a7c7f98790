"""What a sequence gives: a pose and a row for every scan, and what a person should know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.sequence.azimuth import Revolution

STRETCHES = 5  # that the summary tells of


@dataclass(frozen=True)
class SequenceResult:
    """The trajectory of a sequence and everything said about it.

    poses: (n, 4, 4) float64, each scan's frame to the first one's, file units; the camera's where that was asked for.
    rows: one a frame: frame, file, status ("aligned" or "uncertain"), start, points, overlap, inlier_rmse, motion,
    rotation_deg, seconds, and a message where something was wrong with the scan; where directions were not observed,
    unobserved (in words), and sigma_shift and sigma_rotation_deg, how far off the pose may be along them.
    voxel_size: the working voxel edge, file units. odometry_poses: (n, 4, 4) before loops were closed, or None where
    that was not asked for; loops: how many were closed; closed: the frames that each of them joins. out: the file of
    poses, or None. revolution: what points' times followed from, where they did from their azimuth.
    """

    poses: np.ndarray
    rows: list[dict[str, Any]]
    voxel_size: float
    odometry_poses: np.ndarray | None = None
    loops: int = 0
    out: Path | None = None
    closed: tuple[tuple[int, int], ...] = ()
    revolution: Revolution | None = None

    @property
    def status(self) -> str:
        """Says "aligned" where every frame is."""
        return "uncertain" if self.uncertain else "aligned"

    @property
    def uncertain(self) -> list[dict[str, Any]]:
        """The rows of the frames that are not to be trusted."""
        return [row for row in self.rows if row["status"] != "aligned"]

    def summary(self) -> list[str]:
        """What a person wants to know at the end, a line each."""
        length = sum(row["motion"] for row in self.rows)
        residuals = [row["inlier_rmse"] for row in self.rows[1:] if "inlier_rmse" in row]
        written = f": {self.out}" if self.out else ""
        lines = [f"{len(self.rows)} frames, path length {length:.6g}, voxel {self.voxel_size:g}{written}"]
        if self.odometry_poses is not None:
            before = f"; the path before: {odometry_path(self.out)}" if self.out else ""
            lines.append(f"{self.loops} loops closed{before}")
        if self.revolution:
            lines.append(str(self.revolution))
        if residuals:
            worst = max(self.rows[1:], key=lambda row: row.get("inlier_rmse", 0.0))
            lines.append(
                f"residual: median {np.median(residuals):.4g}, "
                f"worst {worst['inlier_rmse']:.4g} in frame {worst['frame']} ({worst['file']})"
            )
        lines += not_observed(self.rows)
        if self.uncertain:
            names = ", ".join(f"{row['frame']} ({row['file']})" for row in self.uncertain[:20])
            more = len(self.uncertain) - 20
            lines.append(f"{len(self.uncertain)} uncertain, look at: {names}{f' and {more} more' if more > 0 else ''}")
        return lines


def not_observed(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each stretch of frames that are uncertain because of what they did not observe; the longest few."""
    stretches: list[list[dict[str, Any]]] = []
    for row in rows:
        if "unobserved" not in row or row["status"] == "aligned":
            continue
        if stretches and row["frame"] == stretches[-1][-1]["frame"] + 1:
            stretches[-1].append(row)
        else:
            stretches.append([row])
    told = sorted(sorted(stretches, key=len, reverse=True)[:STRETCHES], key=lambda stretch: stretch[0]["frame"])
    lines = []
    for stretch in told:
        first, last = stretch[0]["frame"], stretch[-1]["frame"]
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        worst = max(stretch, key=lambda row: row["sigma_shift"])
        lines.append(
            f"{frames}: {worst['unobserved']} not observed, sigma up to {worst['sigma_shift']:.3g} and "
            f"{max(row['sigma_rotation_deg'] for row in stretch):.3g} deg"
        )
    more = len(stretches) - len(told)
    return [*lines, f"{more} shorter stretches where something is not observed"] if more else lines


def odometry_path(out: Path) -> Path:
    """Where the poses before loop closure go."""
    return out.with_name(f"{out.stem}.odometry{out.suffix}")
