"""From a cloud to what the method sees: voxel grid, local origin, working scale, normals, and the exact inverse.

Everything follows from the data's own extent and spacing: multiplying all coordinates by a constant multiplies every
length here by it and changes nothing else.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.geometry.nearest import nearest_within
from fmr_cli.geometry.normals import neighbours_of_all, normals_and_variation
from fmr_cli.geometry.voxels import voxel_downsample, voxel_keys

BORDER = 1e-3  # surface variation that a lean of 1 counts as: below any bend, above the rounding of a plane
MIRRORED = np.array([-1.0, 1.0, 1.0])  # what the mirror x = 0 makes of coordinates; any plane would do
SPARSE = 4.0  # voxel edges: on a full surface 16 neighbours lie within 2.5
Shape = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Surface:
    """A cloud on a voxel grid, with what its neighbourhoods say. points: (M, 3) own unit; edge: of the voxels.

    What is worked out on first use by two surfaces side by side is no ``cached_property``: Python 3.11 has one lock for
    all objects that share it.
    """

    def __init__(self, points: np.ndarray, edge: float, thinned: bool = False) -> None:
        """thinned: the points are the voxels' means already."""
        self.edge = edge
        self.points = points if thinned else voxel_downsample(points, edge)
        self._tree: cKDTree | None = None
        self._known: Shape | None = None

    @property
    def tree(self) -> cKDTree:
        """Of the points. A plain one: points far from all of them are told so in three quarters of the time."""
        if self._tree is None:
            self._tree = cKDTree(self.points, balanced_tree=False, compact_nodes=False)
        return self._tree

    @property
    def _shape(self) -> Shape:
        if self._known is None:
            distance, index = neighbours_of_all(self.points)
            # Of the neighbours, the nearest 3 alone are kept: all are most of what a surface takes of memory.
            self._known = *normals_and_variation(self.points, distance, index), index[:, 1:4].copy()
        return self._known

    @property
    def normals(self) -> np.ndarray:
        """(M, 3) unit normals of undetermined sign."""
        return self._shape[0]

    @property
    def solid(self) -> np.ndarray:
        """(M,) which points have neighbours enough to be a piece of surface; others are dust or a LiDAR's rim."""
        return self._shape[2] < SPARSE * self.edge

    @property
    def lean(self) -> np.ndarray:
        """(M,) how far off each point its neighbours' mean is, as a share of their reach: most at a border."""
        return self._shape[3]

    @cached_property
    def unevenness(self) -> tuple[np.ndarray, np.ndarray]:
        """How far the nearest 3 lie off each point's tangent plane, own unit, and 1 - |cosine| of their normals: (M,).

        What curvature and noise make of two samples of one surface.
        """
        p, n, off, cosine = self.points, self.normals, [], []
        for there in self._shape[4].T:
            off.append(np.abs(np.einsum("ni,ni->n", p[there] - p, n)))
            cosine.append(np.abs(np.einsum("ni,ni->n", n[there], n)))
        return np.mean(off, axis=0), 1 - np.mean(cosine, axis=0)

    def mirrored(self) -> Surface:
        """The same surface in the mirror x = 0 of its own frame; what is known of its neighbourhoods stays."""
        image = copy(self)
        image.points = self.points * MIRRORED
        image._tree = None
        normals, *others = self._shape
        image._known = normals * MIRRORED, *others
        return image

    def keypoints(self, count: int, block: float | None = None) -> np.ndarray:
        """Indices of the points of highest surface variation, at most one in a cell of two voxels, at most ``count``.

        Where neighbours are far, as in a LiDAR's outskirts, variation is chance: such points come last. What is flat
        has its keypoints on its outline. block: own unit; where it is given, ``count`` is of each block of that edge.
        """
        _, variation, reach, lean, _ = self._shape
        order = np.argsort(-np.where(reach < SPARSE * self.edge, variation + BORDER * lean, 0.0), kind="stable")
        first = np.unique(voxel_keys((self.points - self.points.min(0))[order], 2 * self.edge), return_index=True)[1]
        best = order[np.sort(first)]
        if block is None:
            return best[:count]
        keys = voxel_keys(self.points[best] - self.points.min(0), block)
        together = np.argsort(keys, kind="stable")  # block by block, in each the best first
        begins = np.flatnonzero(np.diff(keys[together], prepend=-1))
        rank = np.arange(len(best)) - np.repeat(begins, np.diff(begins, append=len(best)))
        return best[together[rank < count]]

    def patches(self, index: np.ndarray, radius: float, neighbours: int) -> dict[str, np.ndarray]:
        """The neighbourhoods of points ``index`` (K,): what ``patch_encoder.describe_patches`` takes, float32.

        radius: in voxel edges. Offsets are in radii, nearest first; what a row lacks of ``neighbours`` is not valid.
        """
        offsets, valid, found = self.around(self.points[index], radius * self.edge, neighbours)
        normals = self.normals.astype(np.float32)
        return {
            "offsets": offsets, "valid": valid, "normal": normals[index], "neighbours": found, "normals": normals,
        }  # fmt: skip

    def around(self, centres: np.ndarray, radius: float, neighbours: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The at most ``neighbours`` nearest points within ``radius`` of centres (K, 3), own unit, nearest first.

        Their offsets from the centre in radii (K, n, 3) and which of them are there (K, n), float32; their rows (K, n),
        0 where they are not.
        """
        found, there = nearest_within(self.tree, centres, radius, min(neighbours, len(self.points)))
        valid = there.astype(np.float32)
        middle = self.points.mean(0)  # about it, float32 is exact enough
        offsets = ((self.points - middle) / radius).astype(np.float32)[found]
        offsets -= ((centres - middle) / radius).astype(np.float32)[:, None]
        offsets *= valid[..., None]
        return offsets, valid, found
