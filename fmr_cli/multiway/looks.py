"""A cheap look at two scans: whether their local features agree on a pose, and one lies on the other there.

The one place where multiway opens up what ``registration`` prepares: keypoints, descriptors and voxel surfaces of a
scan, on a grid that scans of like size share, so that each scan is described once and not once for each pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from scipy.spatial import cKDTree

from fmr_cli.descriptors.consensus import consensus
from fmr_cli.descriptors.patch_encoder import LocalEncoder
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.sampling import sample
from fmr_cli.multiway.directions import main_directions, turned
from fmr_cli.registration.prepared import LARGEST_RATIO, Prepared

KEYPOINTS = 500
TOLERANCE = 2.0  # voxel edges that a matched point, or a point and its counterpart, may lie apart
POSES = 6  # that the matches agree on most; the right one is hardly ever further down
SAMPLE = 800  # points that are brought onto the other scan
FEW = 3  # matches that agree: fewer fix no pose
WORDS = 32  # of the vocabulary that scans are compared by (VLAD)
VOCABULARY = 20_000  # descriptors that it is learnt from


@dataclass(frozen=True)
class Description:
    """What a look needs of a scan; centred, file's unit.

    edge: of the voxels. keypoints (K, 3), descriptors (K, d). points (M, 3), normals (M, 3), tree: of the voxels.
    some: SAMPLE of their rows. moment: (4, 4) mean of homogeneous x xᵀ, which says how far two poses move the scan
    apart (``displacement``). reach: of the point that is furthest from the centre. directions: see ``directions``.
    """

    edge: float
    keypoints: np.ndarray
    descriptors: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    tree: cKDTree
    some: np.ndarray
    moment: np.ndarray
    reach: float
    directions: np.ndarray | None


@dataclass(frozen=True)
class Look:
    """How promising a pair is, from 0; the pose that says so, between the centred frames; and other poses, less so."""

    promise: float
    T_target_source: np.ndarray
    others: tuple[Look, ...] = ()


def describe(scan: Prepared, edge: float, encoder: LocalEncoder) -> Description:
    """The scan on a grid of ``edge``."""
    keypoints, descriptors = scan.described(edge, KEYPOINTS, encoder)
    surface = scan.surface(edge)
    points = surface.points
    some = sample(np.arange(len(points)), SAMPLE, np.random.default_rng(scan.seed))
    x = np.hstack([points, np.ones((len(points), 1))])
    reach = float(np.linalg.norm(points, axis=1).max())
    return Description(
        edge, keypoints, descriptors, points, surface.normals, surface.tree, some, x.T @ x / len(x), reach,
        main_directions(surface.normals),
    )  # fmt: skip


def shared_edges(own: Sequence[float]) -> list[float]:
    """An edge for each scan, by powers of two of the median: scans of like size share theirs."""
    median = float(np.median(own))
    return [median * 2.0 ** round(np.log2(edge / median)) for edge in own]


def comparable(a: float, b: float) -> bool:
    """Whether two scans' edges are near enough for a pair; they are not where the units differ."""
    return max(a, b) <= 2 * LARGEST_RATIO * min(a, b)


def look(source: Description, target: Description, motion: Motion) -> Look:
    """Matched descriptors, each the other's nearest; the poses they agree on; how much of the source lies there.

    Where both scans have main directions, also the poses that bring them together.
    motion: what may move, with its lift between the centred frames in edges.
    """
    similarity = source.descriptors @ target.descriptors.T
    forth, back = similarity.argmax(1), similarity.argmax(0)
    mutual = np.flatnonzero(back[forth] == np.arange(len(forth)))
    edge = source.edge
    x, y = source.keypoints[mutual] / edge, target.keypoints[forth[mutual]] / edge
    poses, _ = consensus(x, y, TOLERANCE, POSES, motion)
    more = turned(source.keypoints / edge, target.keypoints / edge, similarity,
                  (source.directions, target.directions), motion)  # fmt: skip
    found: list[Look] = []
    for T in np.concatenate([poses, more]):
        count = int((np.linalg.norm(x @ T[:3, :3].T + T[:3, 3] - y, axis=1) < TOLERANCE).sum())
        T[:3, 3] *= edge
        known = any(displacement(T, k.T_target_source, source.moment) < 2 * TOLERANCE * edge for k in found)
        if count >= FEW and not known:
            found.append(Look(float(coincidence(source, target, T) * np.sqrt(count)), T))
    return best_of(found)


def best_of(found: Sequence[Look]) -> Look:
    """The most promising pose with the others behind it."""
    ranked = sorted(found, key=lambda x: -x.promise)
    return Look(ranked[0].promise, ranked[0].T_target_source, tuple(ranked[1:])) if ranked else Look(0.0, np.eye(4))


def coincidence(source: Description, target: Description, T_target_source: np.ndarray) -> float:
    """How much of the source comes close to the target, normals along, from 0 to 1."""
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    reach = TOLERANCE * target.edge
    d, i = target.tree.query(source.points[source.some] @ R.T + t, distance_upper_bound=reach)
    here = np.flatnonzero(np.isfinite(d))
    cosine = np.einsum("ni,ni->n", source.normals[source.some[here]] @ R.T, target.normals[i[here]])
    return float(((1 - d[here] / reach) * cosine**4).sum() / max(len(d), 1))


def overlap(source: Description, target: Description, T_target_source: np.ndarray) -> float:
    """The share of the smaller scan that lies within 1.5 edges of the other one at a pose, on SAMPLE points."""
    T, reach = T_target_source, 1.5 * max(source.edge, target.edge)
    shares = []
    for a, b, g in ((source, target, T), (target, source, np.linalg.inv(T))):
        moved = a.points[a.some] @ g[:3, :3].T + g[:3, 3]
        shares.append(float(np.isfinite(b.tree.query(moved, distance_upper_bound=reach)[0]).mean()))
    return max(shares)


def displacement(A: np.ndarray, B: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """How far apart two poses take a scan's points, root mean square: (..., 4, 4), (..., 4, 4), (4, 4) -> (...)."""
    D = (A - B)[..., :3, :]
    return np.sqrt(np.maximum(np.einsum("...ij,jk,...ik->...", D, moment, D), 0.0))


def similarity(descriptions: Sequence[Description]) -> np.ndarray:
    """How alike scans look as places, from their pooled descriptors (VLAD, Jégou et al. 2010): -> (n, n)."""
    every = np.concatenate([d.descriptors for d in descriptions]).astype(np.float64)
    some = sample(every, VOCABULARY, np.random.default_rng(0))
    words = kmeans2(some, min(WORDS, len(some)), minit="++", seed=0)[0]
    pooled = []
    for d in descriptions:
        word = vq(d.descriptors.astype(np.float64), words)[0]
        sums = np.zeros_like(words)
        np.add.at(sums, word, d.descriptors - words[word])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)  # no word speaks for all
        pooled.append(sums.ravel() / max(np.linalg.norm(sums), 1e-12))
    V = np.stack(pooled)
    return V @ V.T
