"""A map that is known beforehand: scans are registered to it, and found in it where they are lost. In voxels."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import small_gicp

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.voxels import voxel_keys
from fmr_cli.registration.options import Options
from fmr_cli.sequence.prepared_scan import NEIGHBOURS, PreparedScan

if TYPE_CHECKING:
    from fmr_cli.registration.prepared import Prepared

GRAIN = 0.5  # voxels: four points or so of a surface in each voxel tell whether it is flat
NEAR = 1.5  # voxels: what a scan has no further than that from the known map adds nothing to it


class KnownMap:
    """Points (N, 3) with unit normals, whose sides are alike within a voxel and mean nothing else; map axes."""

    def __init__(self, points: np.ndarray) -> None:
        """points: (M, 3), before thinning. Raises RegistrationError where too few are left."""
        thinned = small_gicp.voxelgrid_sampling(points, GRAIN).points()
        if len(thinned) <= NEIGHBOURS:
            raise RegistrationError("the map has too few points to register to")
        self.cloud = small_gicp.PointCloud(thinned)
        self.tree = small_gicp.KdTree(self.cloud)
        small_gicp.estimate_normals_covariances(self.cloud, self.tree, num_neighbors=NEIGHBOURS)
        self.points = self.cloud.points()[:, :3]
        normals = self.cloud.normals()[:, :3]
        _, first, voxel = np.unique(voxel_keys(self.points, 1.0), return_index=True, return_inverse=True)
        sides = np.einsum("ij,ij->i", normals, normals[first][voxel])
        self.normals = normals * np.where(sides < 0, -1.0, 1.0)[:, None]

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """(N,), which of the points (N, 3), map axes, it says nothing about."""
        _, squared = self.tree.batch_nearest_neighbor_search(points)
        return np.array(squared) > NEAR**2

    @cached_property
    def for_align(self) -> Prepared:
        """As feature-metric registration takes it."""
        from fmr_cli.registration.pipeline import prepare

        return prepare(PointCloud(self.points))

    def locate(self, scan: PreparedScan, pair: Options) -> tuple[np.ndarray | None, str]:
        """T_map_scan (4, 4) by ``align``, or None where its verdict is not "aligned"; and why."""
        from fmr_cli.registration import align

        found = align(scan.for_align, self.for_align, pair, hints=False)
        if found.status != "aligned":
            return None, "; ".join(found.reasons) or f"confidence {found.confidence:.2f}"
        return found.T_target_source, ""
