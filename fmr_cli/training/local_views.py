"""Material of the local patch encoder: patches of two made-up scans that show one place, without a label.

The scenes know where both scanners stood, so every keypoint of one scan has its place in the other for free.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from fmr_cli.cloud import transform_points
from fmr_cli.cores import usable_cores
from fmr_cli.descriptors.patch_encoder import NEIGHBOURS, PATCH_RADIUS, describe_patches
from fmr_cli.geometry.sampling import working_scale
from fmr_cli.geometry.surface import Surface
from fmr_cli.synthetic.pairs import degrade, scan_pair

LEAST_POINTS = 500  # of a scan: fewer hardly fill a hundred patches
LEAST_PATCHES = 16  # of a pair: fewer are hardly each other's negatives
VOXELS = (0.8, 1.25)  # times the working voxel: what `align` picks is that uncertain
KEYPOINTS = 1000  # of a scan, among which places are drawn: as many as ``align`` matches
NEAR = 0.75  # voxel edges between two scans' points of one place: within a voxel's own scatter
OWN = 1.0  # voxel edges, within which the other scan's own keypoint stands for the place
FACING = 0.5  # |cosine| between the normals of one place
ALONE = 3.0  # voxel edges: with nothing nearer in the other scan, a place is in one scan alone
ALIKE = 6  # patches of a scan that are compared with each patch
CLOSER = 0.5  # times the distance between two scans' views of one place: patches of one scan that near are aliases
CHUNK = 4  # pairs handed to a worker at a time: a pair takes a tenth of a second, a hand-over milliseconds


@dataclass
class Views:
    """Patches of two scans: source (n, PATCH_POINTS, CHANNELS), target (m, ...), and their places in voxels, one frame.

    The first ``common`` of both show one place, row by row; the others have no counterpart, and are negatives alone.
    place (n, 3), place_target (m, 3). alias (n, m), alias_target (m, n): which patch of the other scan shows what looks
    the same as this one's counterpart and is elsewhere.
    """

    source: Tensor
    target: Tensor
    place: Tensor
    place_target: Tensor
    common: int
    alias: Tensor
    alias_target: Tensor

    def to(self, device: torch.device) -> Views:
        """On the device, patches as float32."""
        moved: dict[str, Any] = {n: v.to(device) for n, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **moved | {name: moved[name].float() for name in ("source", "target")})

    def sparser(self, points: Tensor) -> Views:
        """With so many of each patch's points alone, by their numbers."""
        return replace(self, source=self.source[:, points], target=self.target[:, points])

    def half(self) -> Views:
        """Patches as float16, which takes half the memory and is exact to a thousandth of a patch."""
        return replace(self, source=self.source.half(), target=self.target.half())


def make_views(rng: np.random.Generator, count: int, others: int = 0) -> Views | None:
    """Up to ``count`` corresponding patches of a fresh pair, or None where the two scans hardly share a surface."""
    pair: list[np.ndarray] = list(scan_pair(rng))
    if min(map(len, pair)) >= LEAST_POINTS:
        pair = [degrade(p, rng) for p in pair]
    if min(map(len, pair)) < LEAST_POINTS:
        return None
    scales = [working_scale(p, rng) for p in pair]
    edge = max(max(v for v, _ in scales), max(s for _, s in scales)) * rng.uniform(*VOXELS)
    turned = [Rotation.random(random_state=rng) for _ in pair]
    source, target = (Surface(t.apply(p), edge) for t, p in zip(turned, pair, strict=True))
    T = np.eye(4)
    T[:3, :3] = (turned[1] * turned[0].inv()).as_matrix()
    return between(source, target, T, rng, count, others)


def between(
    source: Surface,
    target: Surface,
    T_target_source: np.ndarray,
    rng: np.random.Generator | None,
    count: int,
    others: int,
) -> Views | None:
    """Up to ``count`` corresponding patches of two surfaces of one edge, and ``others`` of each without a counterpart.

    Without ``rng``, the first ``others`` keypoints of both, whether or not they correspond; none are in common. None
    where the scans hardly share a surface.
    """  # fmt: skip
    edge = source.edge
    moved = transform_points(T_target_source, source.points)
    turned = source.normals @ T_target_source[:3, :3].T
    if rng is None:
        index, match, common = source.keypoints(others), target.keypoints(others), 0
    else:
        keypoints, theirs = source.keypoints(KEYPOINTS), target.keypoints(KEYPOINTS)
        distance, match = target.tree.query(moved[keypoints])
        near, which = cKDTree(target.points[theirs]).query(moved[keypoints])
        match = np.where(near < OWN * edge, theirs[which], match)  # as ``align`` has it: the other scan's own keypoint
        facing = np.abs(np.einsum("ni,ni->n", turned[keypoints], target.normals[match])) > FACING
        both = np.flatnonzero((distance < NEAR * edge) & facing)
        if len(both) < LEAST_PATCHES:
            return None
        both = rng.permutation(both)[:count]
        common = len(both)
        back = cKDTree(moved).query(target.points[theirs])[0]
        alone = [rng.permutation(k[d > ALONE * edge])[:others] for k, d in ((keypoints, distance), (theirs, back))]
        index, match = np.concatenate([keypoints[both], alone[0]]), np.concatenate([match[both], alone[1]])
    a, b = (
        torch.from_numpy(describe_patches(**s.patches(i, PATCH_RADIUS, NEIGHBOURS)))
        for s, i in ((source, index), (target, match))
    )
    places = [torch.from_numpy(p[i] / edge).float() for p, i in ((moved, index), (target.points, match))]
    return Views(a, b, places[0], places[1], common, aliases(a[:common], b, common), aliases(b[:common], a, common))


def aliases(own: Tensor, other: Tensor, common: int) -> Tensor:
    """Which patches of the other scan look like each patch's counterpart: (n, P, C), (m, P, C) -> (n, m) bool.

    Repeated geometry, such as the windows of a facade: two of its patches, each in its own frame, lie on each other
    more closely than two scans' views of one place do. Nothing tells them apart; a loss that tries to learns noise.
    Only the ALIKE nearest in a summary of a patch are compared point by point.
    """
    found = torch.zeros(common, len(other), dtype=torch.bool)
    if common < 2:
        return found
    summary = torch.cat([other.mean(1), other.amax(1)], 1)
    near = torch.cdist(summary[:common], summary)
    near.fill_diagonal_(torch.inf)
    candidates = near.topk(min(ALIKE, len(other) - 1), largest=False).indices  # [n x k]
    same = chamfer(own[..., :3], other[:common, :, :3])  # [n]: two scans' views of one place
    for column in candidates.T:
        apart = chamfer(other[:common, :, :3], other[column][..., :3])
        found[torch.arange(common), column] = apart < CLOSER * same.median()
    return found


def chamfer(a: Tensor, b: Tensor) -> Tensor:
    """The mean distance of nearest points, both ways: (n, P, 3), (n, P, 3) -> (n,)."""
    d = torch.cdist(a, b)
    return (d.amin(1).mean(1) + d.amin(2).mean(1)) / 2


def pair_views(seed: tuple[int, int], count: int, others: int = 0) -> Views:
    """The views of pair ``seed`` = (run, number): the first pair of its own random stream that shares a surface."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    while True:
        views = make_views(rng, count, others)
        if views is not None:
            return views


def make_material(
    pairs: int,
    patches: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda i, n: None,
    workers: int | None = None,
    others: int = 0,
) -> list[Views]:
    """The views of ``pairs`` scan pairs, ``patches`` at most of each (and ``others`` that are in one scan alone).

    The same whatever the number of workers.
    """
    found: list[Views] = []
    with ProcessPoolExecutor(workers or usable_cores(), mp_context=multiprocessing.get_context("spawn")) as pool:
        seeds = [(seed, number) for number in range(pairs)]
        for views in pool.map(partial(pair_views, count=patches, others=others), seeds, chunksize=CHUNK):
            found.append(views)
            progress(len(found), pairs)
    return found
