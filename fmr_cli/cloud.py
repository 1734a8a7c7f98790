"""A point cloud in memory: float64 points, their attributes, and what the file said about them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fmr_cli.vectors import turn_vectors

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", np.ndarray, "Tensor")

NORMALS = ("nx", "ny", "nz")


@dataclass
class PointCloud:
    """Points with per-point attributes.

    points: (N, 3) float64, in the file's own unit and frame; every coordinate finite.
    attributes: name -> (N,) or (N, k) array in the file's own dtype. Names are unified over the formats:
        ``red green blue alpha``, ``nx ny nz``, ``intensity``; every other field keeps the file's name.
    path, format: where the cloud came from ("ply", "pcd", "las", "laz", "e57", "kitti", "xyz", "csv", "npy", "npz",
        "mesh", ...). layout: what a reader made out by the values ("x y z intensity ring"), or None.
    dropped: how many points of the file were left out because a coordinate was NaN or infinite.
    total: how many points the file has besides those dropped, where only some of them were kept; else None.
    crs: the coordinate reference system as the file states it (WKT or "EPSG:n"), or None.
    sensor_origin: (3,) float64 position of the sensor where the file states it, or None.
    las_header: the ``laspy.LasHeader`` of a LAS/LAZ file (scales, offsets, VLRs), so that it can be written again.
    left_out: what else the file holds and is not kept ("list property 'neighbours'", "element 'edge'").
    notes: what is odd about the file, for a person to look at ("3 lines beyond the 100 points that ...").
    mesh: (vertices, faces) of the mesh whose surface was sampled, or None.
    scan, T_file_scan: of a file of several scans, the name of the one that the points are from, and its pose in the
        file's frame (4x4), in which the points are; None where the file tells no scans apart.
    """

    points: np.ndarray
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    path: Path | None = None
    format: str | None = None
    dropped: int = 0
    crs: str | None = None
    sensor_origin: np.ndarray | None = None
    las_header: Any = None
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    mesh: tuple[int, int] | None = None
    layout: str | None = None
    total: int | None = None
    scan: str | None = None
    T_file_scan: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.points = np.asarray(self.points, dtype=np.float64)
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f"points must have shape (N, 3), not {self.points.shape}")
        for name, values in self.attributes.items():
            if len(values) != len(self.points):
                raise ValueError(f"attribute {name!r} has {len(values)} values for {len(self.points)} points")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def count(self) -> int:
        """How many points the file has, besides those dropped."""
        return len(self) if self.total is None else self.total

    @property
    def name(self) -> str:
        """The file's path for messages, or a placeholder for a cloud made in memory."""
        return str(self.path) if self.path else "<cloud in memory>"

    def select(self, index: np.ndarray | slice) -> PointCloud:
        """The points (and their attributes) at an index array, a boolean mask of shape (N,), or a slice."""
        return replace(
            self, points=self.points[index], attributes={name: v[index] for name, v in self.attributes.items()}
        )

    def with_attribute(self, name: str, values: np.ndarray) -> PointCloud:
        """A copy that also holds ``values`` (N,) under ``name``."""
        return replace(self, attributes={**self.attributes, name: np.asarray(values)})

    def transformed(self, T: np.ndarray) -> PointCloud:
        """The cloud moved by T (4x4, float64, rigid, or with a uniform scale s, or a mirror): x -> s R x + t.

        Attributes that are vectors move along (`fmr_cli.vectors`), and so do the sensor's position and the scan's pose.
        """
        moved = replace(self, points=transform_points(T, self.points), attributes=turn_vectors(self.attributes, T))
        scale = np.cbrt(abs(np.linalg.det(T[:3, :3])))
        if self.las_header is not None and abs(scale - 1) > 1e-6:
            moved.las_header = self.las_header.copy()
            moved.las_header.scales = self.las_header.scales * scale  # as many steps across the cloud as before
        if self.sensor_origin is not None:
            moved.sensor_origin = transform_points(T, self.sensor_origin[None])[0]
        if self.T_file_scan is not None:
            moved.T_file_scan = T @ self.T_file_scan
        return moved


def transform_points(T: Array, points: Array) -> Array:
    """R x + t for every row x of points (..., N, 3); T is (..., 4, 4); numpy or torch, batch dimensions broadcast."""
    return points @ T[..., :3, :3].swapaxes(-1, -2) + T[..., None, :3, 3]


def rotation_angle(R: np.ndarray) -> np.ndarray:
    """The angles of rotations (..., 3, 3) in radians, (...); exact near zero and near pi, where arccos is not."""
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    return np.arctan2(np.sqrt(x * x + y * y + z * z), R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1)


def angle_degrees(T: np.ndarray) -> float:
    """The rotation angle of T's (scaled) rotation, degrees: (4, 4) or (3, 3)."""
    return float(np.degrees(rotation_angle(T[:3, :3] / np.cbrt(np.linalg.det(T[:3, :3])))))
