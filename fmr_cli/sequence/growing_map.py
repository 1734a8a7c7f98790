"""A map that grows scan by scan and holds one point a voxel, so that its size is bounded by the place, not the time."""

from __future__ import annotations

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.voxels import voxel_keys


class GrowingMap:
    """The first point that fell into each voxel of edge ``voxel``, with its attributes and the frame it came from."""

    def __init__(self, voxel: float) -> None:
        self.voxel = voxel
        self.keys = np.zeros(0, np.int64)  # of the voxels taken, sorted
        self.parts: list[PointCloud] = []

    def add(self, cloud: PointCloud, pose: np.ndarray, frame: int) -> None:
        """Add the points of a scan that lie where nothing is yet; pose (4, 4) takes it to the map's frame."""
        moved = cloud.transformed(pose)
        keys, first = np.unique(voxel_keys(moved.points, self.voxel), return_index=True)
        place = np.searchsorted(self.keys, keys)
        known = np.zeros(len(keys), bool)
        inside = place < len(self.keys)
        known[inside] = self.keys[place[inside]] == keys[inside]
        self.keys = np.insert(self.keys, place[~known], keys[~known])
        new = moved.select(np.sort(first[~known]))
        self.parts.append(new.with_attribute("frame", np.full(len(new), frame, np.int32)))

    def cloud(self) -> PointCloud:
        """All points, with the attributes that every scan had, and ``frame``."""
        common = set.intersection(*(set(part.attributes) for part in self.parts))
        names = [name for name in self.parts[0].attributes if name in common]
        return PointCloud(
            np.concatenate([part.points for part in self.parts]),
            {name: np.concatenate([part.attributes[name] for part in self.parts]) for name in names},
            crs=self.parts[0].crs,
        )
