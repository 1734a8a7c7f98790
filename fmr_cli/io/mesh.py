"""Meshes: OFF, OBJ and STL (PLY with faces comes from ply.py); their surface is sampled, area by area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError

FEWEST, MOST = 10_000, 1_000_000  # points sampled by default; in between, as many as the mesh has vertices


@dataclass
class Mesh:
    """Vertices (as a cloud with attributes, not yet checked for NaN) and the (M, 3) indices of its triangles."""

    vertices: PointCloud
    triangles: np.ndarray

    def sample(self, count: int | None, seed: int) -> PointCloud:
        """``count`` points spread evenly over the surface, the same for the same seed; 0 gives the vertices.

        Each point takes the attributes of its triangle's nearest corner.
        """
        cloud, corners = self.vertices, self.triangles
        size = (len(cloud), len(corners))
        if count == 0:
            return replace(cloud, mesh=size)
        if corners.min() < 0 or corners.max() >= len(cloud):
            raise CloudFileError(f"has a face that refers to a vertex it does not have ({len(cloud)} vertices)")
        finite = np.isfinite(cloud.points).all(1)
        corners = corners[finite[corners].all(1)]
        a, b, c = (cloud.points[corners[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        total = np.cumsum(area)
        if len(total) == 0 or not 0 < total[-1] < np.inf:
            raise CloudFileError("is a mesh without any surface to sample")
        if count is None:
            count = min(max(len(cloud), FEWEST), MOST)
        rng = np.random.default_rng(seed)
        face = np.minimum(np.searchsorted(total, rng.random(count) * total[-1], side="right"), len(corners) - 1)
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1 - u, u * (1 - v), u * v], 1)
        points = np.einsum("nk,nkd->nd", weights, cloud.points[corners[face]])
        nearest = corners[face, weights.argmax(1)]
        sampled = {name: values[nearest] for name, values in cloud.attributes.items()}
        dropped = int(len(finite) - finite.sum())
        return replace(cloud, points=points, attributes=sampled, dropped=dropped, mesh=size)


def fan(faces: Sequence[Sequence[int]] | np.ndarray) -> np.ndarray:
    """(M, 3) triangles of polygons with any number of corners; those with fewer than three are left out."""
    if isinstance(faces, np.ndarray):
        groups = [faces.astype(np.int64)]
    else:
        lengths = np.fromiter(map(len, faces), np.int64, len(faces))
        groups = [
            np.array([faces[i] for i in np.flatnonzero(lengths == k)], dtype=np.int64) for k in np.unique(lengths)
        ]
    triangles = [g[:, [0, i, i + 1]] for g in groups if g.ndim == 2 for i in range(1, g.shape[1] - 1)]
    return np.concatenate(triangles) if triangles else np.empty((0, 3), np.int64)
