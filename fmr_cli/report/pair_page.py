"""The report of one pair, ``fmr align --report``: whether the pose is right, and why the tool thinks so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.geometry.kernels import NORMAL
from fmr_cli.geometry.normals import neighbours, smallest_eigenvector
from fmr_cli.geometry.sampling import sample
from fmr_cli.io import transform_text
from fmr_cli.registration.agreement import TOUCHING
from fmr_cli.registration.result import Registration, versions
from fmr_cli.report import words
from fmr_cli.report.page import write_page
from fmr_cli.report.points import packed, packed_shares, shown

MEASURED = 200_000  # points of the target that residuals are measured to: their tree takes 0.1 s
RESIDUALS = 2.0  # working voxel edges: the largest residual that is told from a larger one
ALTERNATIVES = 5  # that can be switched to


@dataclass(frozen=True)
class Residuals:
    """Of moved points against the target.

    point: to the nearest point; plane: to the plane through that point's neighbours; both (N,).
    """

    point: np.ndarray
    plane: np.ndarray


class Target:
    """The target as residuals are measured to it.

    spacing: the median distance to a point's nearest neighbour; noise: the standard deviation of points about the
    planes through their neighbourhoods (curvature counts as well); own unit.
    """

    def __init__(self, points: np.ndarray) -> None:
        self.points = sample(points, MEASURED, np.random.default_rng(0))
        self.tree = cKDTree(self.points, balanced_tree=False, compact_nodes=False)
        some = sample(self.points, 5_000, np.random.default_rng(1))
        distance, index = neighbours(some, self.tree)
        self.spacing = float(np.median(distance[:, 1])) if distance.shape[1] > 1 else 0.0
        self.noise = float(NORMAL * np.median(self.off_planes(some, index)))

    def off_planes(self, points: np.ndarray, index: np.ndarray) -> np.ndarray:
        """How far points (N, 3) are off the planes through the target's points index (N, k): (N,)."""
        near = self.points[index]
        middle = near.mean(1)
        x, y, z = np.moveaxis(near - middle[:, None], 2, 0)
        products = [np.einsum("ij,ij->i", a, b) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))]
        return np.abs(np.einsum("ni,ni->n", points - middle, smallest_eigenvector(*products)[0]))

    def residuals(self, moved: np.ndarray, reach: float) -> Residuals:
        """Of points (N, 3); beyond ``reach`` both are infinite."""
        distance, match = self.tree.query(moved, distance_upper_bound=reach)
        near = np.flatnonzero(np.isfinite(distance))
        plane = np.full(len(moved), np.inf)
        if len(near):
            unique, back = np.unique(match[near], return_inverse=True)
            index = neighbours(self.points[unique], self.tree)[1]
            plane[near] = self.off_planes(moved[near], index[back])
        return Residuals(distance, plane)


def write_pair(
    path: Path, source: PointCloud, target: PointCloud, found: Registration, outputs: Sequence[Path] = ()
) -> None:
    """The report of a registration of ``source`` onto ``target``, as one HTML file. outputs: what else was written."""
    middle = target.points.mean(0)
    data = pair_data(source, target, found, middle)
    poses = data["poses"]
    write_page(
        path, "pair.html", data, ("clouds.js", "pair.js"), found=found, poses=poses,
        verdict=words.VERDICTS[found.status], reasons=words.advice(found.reasons), arrows=data["arrows"],
        shares=shares(data), sigma=sigma_table(found), files=[file_row("source", source), file_row("target", target)],
        evidence=[(*words.EVIDENCE.get(name, (name, "")), value) for name, value in found.evidence.items()],
        options=vars(found.options), versions=versions(), middle=middle.tolist(), outputs=[str(p) for p in outputs],
        more=max(len(found.alternatives) - ALTERNATIVES, 0), motion=words.motion_words(
            found.T_target_source, source.points.mean(0)
        ),
    )  # fmt: skip


def pair_data(source: PointCloud, target: PointCloud, found: Registration, middle: np.ndarray) -> dict[str, Any]:
    """What the page's scripts draw: centred points, poses between them, residuals at each."""
    moving, fixed = shown(source.points), shown(target.points)
    own = moving.mean(0)
    reference, limit = Target(target.points - middle), RESIDUALS * found.voxel_size
    poses = [named("before", "as the files are", np.eye(4)),
             named("result", "found", found.T_target_source, found.confidence)]  # fmt: skip
    for n, other in enumerate(found.alternatives[:ALTERNATIVES], 1):
        T = np.array(other["T_target_source"])
        apart = words.motion_words(T @ np.linalg.inv(found.T_target_source), transform_points(T, own[None])[0])
        poses.append(named(f"alternative {n}", apart, T, other["confidence"]))
    for pose in poses:
        T = pose.pop("T")
        moved = transform_points(T, moving) - middle
        at = reference.residuals(moved, limit)
        inside = at.point <= TOUCHING * found.voxel_size
        local = T.copy()
        local[:3, 3] = T[:3, :3] @ own + T[:3, 3] - middle
        pose |= {
            "matrix": local.tolist(), "text": transform_text(T), "point": packed_shares(at.point, limit),
            "plane": packed_shares(at.plane, limit), "overlap": float(inside.mean()),
            "errors": {name: spread(value[inside]) for name, value in vars(at).items()},
        }  # fmt: skip
    size = float(np.linalg.norm(np.ptp(np.quantile(fixed, [0.02, 0.98], axis=0), axis=0)))
    return {
        "clouds": [{"name": "target", "file": target.name, "points": packed(fixed - middle)},
                   {"name": "source", "file": source.name, "points": packed(moving - own)}],
        "poses": poses, "limit": limit, "voxel": found.voxel_size, "spacing": reference.spacing,
        "noise": reference.noise, "size": size, "arrows": words.directions(found.undetermined),
        "scene": "pair",
    }  # fmt: skip


def named(name: str, what: str, T: np.ndarray, confidence: float | None = None) -> dict[str, Any]:
    return {"name": name, "words": what, "confidence": confidence, "T": T}


def spread(values: np.ndarray) -> dict[str, float | None]:
    """Median and root mean square of residuals, None where there are none."""
    if not len(values):
        return {"median": None, "rms": None}
    return {"median": float(np.median(values)), "rms": float(np.sqrt(np.mean(np.square(values))))}


def shares(data: dict[str, Any]) -> dict[str, int]:
    """How many points of each cloud the page holds."""
    return {cloud["name"]: len(cloud["points"]) * 3 // 4 // 12 for cloud in data["clouds"]}


def sigma_table(found: Registration) -> dict[str, Any]:
    """Standard deviations of the pose: the largest, and by axis of the target's frame.

    A direction that is not determined has none; strength is the share of the strongest axis' information.
    """
    C, information = found.covariance, found.information
    length = max(float(np.sqrt(np.trace(information[:3, :3]) / max(np.trace(information[3:, 3:]), 1e-300))), 1e-12)
    sigma = np.sqrt(np.maximum(np.diag(C), 0))
    strength = np.sqrt(np.maximum(np.diag(information), 0)) * np.array([1 / length] * 3 + [1.0] * 3)
    strength = strength / max(float(strength.max()), 1e-300)
    open_ways = [(d["kind"], np.array(d["vector"])) for d in words.directions(found.undetermined)]
    rows = []
    for axis, name in enumerate("xyz"):
        free = {kind: any(k == kind and abs(v[axis]) > 0.3 for k, v in open_ways) for kind in ("rotation", "shift")}
        rows.append({
            "axis": name, "rotation": None if free["rotation"] else float(np.degrees(sigma[axis])),
            "shift": None if free["shift"] else float(sigma[3 + axis]),
            "rotation_strength": 0.0 if free["rotation"] else float(strength[axis]),
            "shift_strength": 0.0 if free["shift"] else float(strength[3 + axis]),
        })  # fmt: skip
    worst = [float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0))) for block in (C[:3, :3], C[3:, 3:])]
    return {"rows": rows, "rotation": float(np.degrees(worst[0])), "shift": worst[1]}


def file_row(role: str, cloud: PointCloud) -> dict[str, Any]:
    return {
        "role": role, "file": cloud.name, "points": cloud.count, "used": len(cloud), "dropped": cloud.dropped,
        "format": cloud.format or "", "layout": cloud.layout or "", "crs": (cloud.crs or "")[:80],
        "extent": " \u00d7 ".join(f"{x:.4g}" for x in np.ptp(cloud.points, axis=0)),
    }  # fmt: skip
