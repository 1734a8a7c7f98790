"""Fewer points of a cloud: distinct ones, random ones, evenly spread ones; and the spacing of what is there."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.geometry.voxels import occupied_voxels

WORKING_VOXELS = 5000  # the voxel edge is chosen so that about so many are occupied
SAMPLE = 15_000  # points that the choice of the voxel edge looks at
WITHIN = 0.98  # share of a cloud's points within its reach
SPACING_SAMPLE = 1_000  # of them, whose nearest neighbour is looked up
SCALE_ROUNDS, SCALE_TOLERANCE = 20, 0.02  # rounds at most; share of the wanted voxels that may be too many
OBLIQUE = 0.5377, 0.3183, 0.7809  # a line that no usual grid is square to


def distinct(points: np.ndarray) -> np.ndarray:
    """The points without exact repetitions, of each the first, in their order: (N, 3) -> (M, 3), M <= N.

    Equal points meet in their distance along one oblique line, and hardly any others do: only those that meet are
    compared. Of a million points of which none are equal that takes a tenth of the time of sorting them.
    """
    x, y, z = points.T
    along = x * OBLIQUE[0] + y * OBLIQUE[1] + z * OBLIQUE[2]  # term by term: equal points to equal bits
    ordered = np.sort(along)
    met = ordered[1:][ordered[1:] == ordered[:-1]]
    if not len(met):
        return points
    some = np.flatnonzero(met[np.searchsorted(met, along).clip(max=len(met) - 1)] == along)
    order = some[np.lexsort((some, *points[some].T))]
    keep = np.ones(len(points), bool)
    keep[order[1:][(np.diff(points[order], axis=0) == 0).all(1)]] = False
    return points[keep]


def thinned(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most about ``count`` points, one from each stretch of the array, without a copy of it: (N, 3) -> (M, 3)."""
    if len(points) <= count:
        return points
    return points[((np.arange(count) + rng.random(count)) * (len(points) / count)).astype(int)]


def sample(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` points without repetition, (N, 3) -> (min(N, count), 3)."""
    return points if len(points) <= count else points[rng.choice(len(points), count, replace=False)]


def reach(points: np.ndarray, rng: np.random.Generator) -> float:
    """How far most of the points (N, 3) lie from their middle, own unit."""
    some = thinned(points, SAMPLE, rng)
    return float(np.quantile(np.linalg.norm(some - np.median(some, axis=0), axis=1), WITHIN))


def working_scale(points: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """The voxel edge at which about ``WORKING_VOXELS`` are occupied, and the spacing of distinct points, own unit.

    Both by count, so that a few points far away do not matter. The spacing is the median distance to the nearest other
    point, rescaled from a sample as on a surface.
    """
    some = sample(points, SAMPLE, rng)
    tree = cKDTree(some, balanced_tree=False, compact_nodes=False)
    spacing = float(np.median(tree.query(sample(some, SPACING_SAMPLE, rng), 2)[0][:, 1]))
    edge, count = spacing, len(some)
    for _ in range(SCALE_ROUNDS):  # on a surface the count falls with the edge's square
        if count < (1 + SCALE_TOLERANCE) * WORKING_VOXELS:
            break
        edge *= np.sqrt(count / WORKING_VOXELS)
        count = occupied_voxels(some, edge)
    return edge, spacing * np.sqrt(len(some) / max(len(points), len(some)))


def to_size(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` of the points (N, 3) in random order, repeated where N is smaller; normalised, float32."""
    points = sample(points, count, rng)
    points = points[np.concatenate([rng.permutation(len(points)) for _ in range(-(-count // len(points)))])[:count]]
    points = points - points.mean(0)
    return (points * (0.5 / np.abs(points).max())).astype(np.float32)
