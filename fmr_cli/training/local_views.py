"""Material of the local patch encoder: patches of two made-up scans that show one place, without a label.

The scenes know where both scanners stood, so every keypoint of one scan has its place in the other for free. Half of
the pairs are ordinary, half are hard: little overlap, few points, and bent as real scans are.
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
from fmr_cli.descriptors.patch_encoder import NEIGHBOURS, PATCH_POINTS, PATCH_RADIUS, describe_patches
from fmr_cli.geometry.sampling import working_scale
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration.looks import WIDER
from fmr_cli.synthetic.calibration_pairs import bent_pair
from fmr_cli.synthetic.draft import log_uniform
from fmr_cli.synthetic.pairs import degrade, scan_pair
from fmr_cli.synthetic.verdict_pairs import FAMILIES, make_pair

LEAST_POINTS = 500  # of a scan: fewer hardly fill a hundred patches
LEAST_PATCHES = 16  # of a pair: fewer are hardly each other's negatives
VOXELS = 0.7, WIDER[0]  # times the working voxel: all that ``align`` looks at, and somewhat finer
HARD = 0.5  # of the pairs
BENT = 0.6  # of the hard pairs
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

    Patches are kept as float16, which takes half the memory and is exact to a thousandth of a patch. The first
    ``common`` of both show one place, row by row; the others have no counterpart, and are negatives alone.
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


def some_points(count: int, generator: torch.Generator) -> Tensor:
    """The numbers of ``count`` of a patch's points, drawn at random, for ``Views.sparser``."""
    return torch.randperm(PATCH_POINTS, generator=generator, device=generator.device)[:count].cpu()


def made_up_scans(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two scans (N, 3), (M, 3) of one made-up scene, and T_target_source."""
    if rng.random() < HARD:
        pair = make_pair(str(rng.choice(list(FAMILIES["shy"]))), rng)
        if rng.random() < BENT:
            pair = bent_pair(pair, rng)
        return pair.source, pair.target, pair.poses[0]
    source, target = (degrade(p, rng) if len(p) >= LEAST_POINTS else p for p in scan_pair(rng))
    return source, target, np.eye(4)


def make_views(rng: np.random.Generator, count: int, others: int = 0) -> Views | None:
    """Up to ``count`` corresponding patches of a fresh pair, or None where the two scans hardly share a surface."""
    *clouds, T = made_up_scans(rng)
    if min(map(len, clouds)) < LEAST_POINTS:
        return None
    scales = [working_scale(points, rng) for points in clouds]
    edge = max(max(v for v, _ in scales), max(s for _, s in scales)) * log_uniform(rng, *VOXELS)
    turns = [turn(points, rng) for points in clouds]  # each as its voxel grid may lie on it
    source, target = (Surface(transform_points(G, points), edge) for G, points in zip(turns, clouds, strict=True))
    return between(source, target, turns[1] @ T @ np.linalg.inv(turns[0]), rng, count, others)


def turn(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random rotation (4, 4) about the points' mean, which becomes the origin."""
    G = np.eye(4)
    G[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    G[:3, 3] = -G[:3, :3] @ points.mean(0)
    return G


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
    near_a, near_b = aliases(a[:common], b, common), aliases(b[:common], a, common)
    places = [torch.from_numpy(p[i] / edge).float() for p, i in ((moved, index), (target.points, match))]
    return Views(a.half(), b.half(), places[0], places[1], common, near_a, near_b)


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


def pair_arrays(seed: tuple[int, int], count: int, others: int) -> dict[str, Any]:
    """``pair_views`` in numpy: tensors go between processes as open files, of which a process may have few."""
    plain = vars(pair_views(seed, count, others))
    return {name: value if name == "common" else value.numpy() for name, value in plain.items()}


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
        for plain in pool.map(partial(pair_arrays, count=patches, others=others), seeds, chunksize=CHUNK):
            arrays: dict[str, Any] = {n: torch.from_numpy(v) if n != "common" else v for n, v in plain.items()}
            found.append(Views(**arrays))
            progress(len(found), pairs)
    return found
