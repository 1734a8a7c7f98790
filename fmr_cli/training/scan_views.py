"""Material of the local patch encoder from the user's scans: patches of one place in two scans whose pose is known.

Pairs come from scans that registration has placed, or from one scan twice: cut, thinned out, shaken, half hidden.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.descriptors.matching import match
from fmr_cli.geometry.sampling import working_scale
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration.prepared import SPACINGS
from fmr_cli.synthetic.pairs import degrade, scan_pair
from fmr_cli.synthetic.sensors import overlap
from fmr_cli.training.local_views import Views, between

SCALES = (0.7, 1.0, 1.4, 1.5)  # times the working voxel: those that ``align`` looks at
JITTER = 0.1  # of the logarithm of a scale
UNTOUCHED = 0.75  # of the registered pairs stay as they are
LEAST_POINTS = 500  # of a scan or a part of it
SHARES = 0.15, 0.9  # of the surface, that two parts of one scan share
HIDDEN = 0.5  # of the parts are seen from a made-up viewpoint
FROM = 0.5, 2.5  # of the scan's radius, that this viewpoint lies off its middle
CELL, BEHIND = 1.5, 3.0  # edges at a part's middle that a cell of the view is wide; edges behind its nearest: hidden
LEAST_SHARED = 0.2  # of the smaller of two made-up scans, that the other one has
INLIER = 2.0  # voxel edges, as the consensus of ``align`` takes it


@dataclass(frozen=True)
class Overlapping:
    """Two clouds (N, 3), (M, 3), any frames, one unit; T_target_source; edge: the voxel edge that suits both."""

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    edge: float


def drawn_views(
    pair: Overlapping, rng: np.random.Generator, count: int, others: int, touch: bool = True
) -> Views | None:
    """Patches of a pair at one of the scales of ``align``, now and then as worse sensors would give it."""
    clouds = [pair.source, pair.target]
    if touch and rng.random() > UNTOUCHED:
        clouds = [degrade(points, rng) for points in clouds]
    if min(map(len, clouds)) < LEAST_POINTS:
        return None
    T = pair.T_target_source
    if rng.random() < 0.5:
        clouds, T = clouds[::-1], np.linalg.inv(T)
    spacing = max(working_scale(points, rng)[1] for points in clouds)
    edge = max(pair.edge, SPACINGS * spacing) * rng.choice(SCALES) * np.exp(rng.normal(0, JITTER))
    source, target = (Surface(points, edge) for points in clouds)
    return between(source, target, T, rng, count, others)


def seen_twice(points: np.ndarray, rng: np.random.Generator, share: float | None = None) -> Overlapping | None:
    """Two parts of one scan (N, 3) that share about ``share`` of each, as two scans would have them.

    None where too few points are left.
    """
    points = points - points.mean(0)
    share = rng.uniform(*SHARES) if share is None else share
    edge, spacing = working_scale(points, rng)
    direction = rng.normal(size=3)
    depth = points @ (direction / np.linalg.norm(direction))
    low, high = np.quantile(depth, [(1 - share) / (2 - share), 1 / (2 - share)])
    parts = [points[depth >= low], points[depth <= high]]
    if len(points) > 8 * LEAST_POINTS:  # enough for each part to have points of its own
        own = rng.random(len(points)) < 0.5
        parts = [points[(depth >= low) & own], points[(depth <= high) & ~own]]
        spacing *= 2**0.5
    parts = [part if rng.random() > HIDDEN else visible(part, rng, edge) for part in parts]
    if min(map(len, parts)) < LEAST_POINTS:
        return None
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    noise = rng.uniform(0.02, 0.2) * edge
    source, target = (part + rng.normal(0, noise, part.shape) for part in parts)
    return Overlapping(source, transform_points(turn, target), turn, max(edge, SPACINGS * spacing))


def visible(points: np.ndarray, rng: np.random.Generator, edge: float) -> np.ndarray:
    """What of the points (N, 3) is seen from a made-up viewpoint: nothing much nearer lies in the same direction."""
    if not len(points):
        return points
    middle = points.mean(0)
    radius = np.linalg.norm(points - middle, axis=1).mean()
    away = rng.normal(size=3)
    off = points - middle - away / np.linalg.norm(away) * radius * rng.uniform(*FROM)
    distance = np.maximum(np.linalg.norm(off, axis=1), 1e-9)
    step = CELL * edge / np.median(distance)  # rad
    cell = np.floor(np.stack([np.arctan2(off[:, 1], off[:, 0]), np.arcsin(off[:, 2] / distance)], 1) / step)
    _, index = np.unique(cell, axis=0, return_inverse=True)
    nearest = np.full(index.max() + 1, np.inf)
    np.minimum.at(nearest, index.ravel(), distance)
    return points[distance < nearest[index.ravel()] + BEHIND * edge]


def whole_views(pair: Overlapping, count: int) -> Views | None:
    """All of both scans that ``align`` would match, at its working voxel: to count how many matches are right."""
    return between(
        Surface(pair.source, pair.edge), Surface(pair.target, pair.edge), pair.T_target_source, None, 0, count
    )  # fmt: skip


def inlier_ratio(source: np.ndarray, target: np.ndarray, views: Views) -> float:
    """Of the matches between descriptors (K, d), (L, d), the share that is right at the known pose."""
    pairs = match(source, target)
    off = np.linalg.norm(views.place.numpy()[pairs[:, 0]] - views.place_target.numpy()[pairs[:, 1]], axis=1)
    return float((off < INLIER).mean())


def made_up_pair(seed: tuple[int, ...]) -> Overlapping:
    """Two procedural scans of one place that share a surface, each in a frame of its own."""
    rng = np.random.default_rng(seed)
    while True:
        clouds = [degrade(points, rng) if len(points) else points for points in scan_pair(rng)]
        if min(map(len, clouds)) < LEAST_POINTS:
            continue
        scales = [working_scale(points, rng) for points in clouds]
        edge = max(max(own, SPACINGS * spacing) for own, spacing in scales)
        turned = [Rotation.random(random_state=rng) for _ in clouds]
        T = np.eye(4)
        T[:3, :3] = (turned[1] * turned[0].inv()).as_matrix()
        pair = Overlapping(turned[0].apply(clouds[0]), turned[1].apply(clouds[1]), T, edge)
        if max(overlap(clouds[0], clouds[1], 1.5 * edge)) >= LEAST_SHARED:
            return pair
