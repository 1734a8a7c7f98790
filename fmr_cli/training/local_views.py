"""Material of the local patch encoder: patches of two made-up scans that show one place, without a label.

The scenes know where both scanners stood, so every keypoint of one scan has its place in the other for free.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from fmr_cli.cores import usable_cores
from fmr_cli.descriptors.patch_encoder import NEIGHBOURS, PATCH_RADIUS, describe_patches
from fmr_cli.geometry.sampling import working_scale
from fmr_cli.geometry.surface import Surface
from fmr_cli.synthetic.pairs import degrade, scan_pair

LEAST_POINTS = 500  # of a scan: fewer hardly fill a hundred patches
LEAST_PATCHES = 16  # of a pair: fewer are hardly each other's negatives
VOXELS = (0.8, 1.25)  # times the working voxel: what `align` picks is that uncertain
NEAR = 0.75  # voxel edges between two scans' keypoints of one place: within a voxel's own scatter
CHUNK = 4  # pairs handed to a worker at a time: a pair takes a tenth of a second, a hand-over milliseconds


@dataclass
class Views:
    """Corresponding patches of two scans: (n, PATCH_POINTS, CHANNELS) each, and their places (n, 3) in voxels."""

    source: Tensor
    target: Tensor
    place: Tensor

    def to(self, device: torch.device) -> Views:
        return Views(self.source.to(device), self.target.to(device), self.place.to(device))


def make_views(rng: np.random.Generator, count: int) -> Views | None:
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
    where = turned[0].apply(source.points, inverse=True)
    distance, match = cKDTree(turned[1].apply(target.points, inverse=True)).query(where)
    index = source.keypoints(2 * count)
    index = index[distance[index] < NEAR * edge]
    if len(index) < LEAST_PATCHES:
        return None
    index = rng.permutation(index)[:count]
    a, b = (
        torch.from_numpy(describe_patches(**s.patches(i, PATCH_RADIUS, NEIGHBOURS)))
        for s, i in ((source, index), (target, match[index]))
    )
    return Views(a, b, torch.from_numpy(where[index] / edge).float())


def pair_views(seed: tuple[int, int], count: int) -> Views:
    """The views of pair ``seed`` = (run, number): the first pair of its own random stream that shares a surface."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    while True:
        views = make_views(rng, count)
        if views is not None:
            return views


def make_material(
    pairs: int,
    patches: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda i, n: None,
    workers: int | None = None,
) -> list[Views]:
    """The views of ``pairs`` scan pairs, ``patches`` at most of each, the same whatever the number of workers."""
    found: list[Views] = []
    with ProcessPoolExecutor(workers or usable_cores(), mp_context=multiprocessing.get_context("spawn")) as pool:
        seeds = [(seed, number) for number in range(pairs)]
        for views in pool.map(partial(pair_views, count=patches), seeds, chunksize=CHUNK):
            found.append(views)
            progress(len(found), pairs)
    return found
