"""How two surfaces agree at a pose: what each explains of the other, and what contradicts it.

Only the common region speaks: a point that lies over a part of the other surface, not beyond its border. There it is
explained if it lies on that surface and faces along with it, and contradicted if it floats above or below, or
faces across: the other scan saw a surface here and not this one. So the border of a scan, which is where the sensor's
view ends, says nothing; nor do normals of points whose neighbours' own differ, as along an edge. What contradicts here
and there is an edge or a thin part that two views see differently; what does so together, a thing that one scan lacks.
Distances count in voxel edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.corner import share_beyond_corner
from fmr_cli.geometry.point_to_plane import FACING, point_to_plane
from fmr_cli.geometry.surface import Surface

REACH = 4.0  # voxel edges: further off, a point is no business of a surface: a table does not contradict the floor
TOUCHING = 1.5  # voxel edges: nearer points overlap, as voxels of one surface do
OVER = 1.0  # voxel edges along the tangent plane, within which a point lies over a surface point
CLEAR, UNEVEN = 0.5, 2.5  # voxel edges, and times the surface's own unevenness: an offset beyond both contradicts
ACROSS = 0.4  # |cosine| between normals: from FACING on they agree, below this they contradict
# Lean of a surface point (``normals_and_variation``) from which it may lie at a border, where the other scan goes on:
# 0.42 at a straight border, 0.15 in the median and up to 0.3 within. A border's normals mix what ends there.
AT_BORDER = 0.25
# Of the points nearest to a contradicted one (itself among them, within LIKE_REACH edges), those that are contradicted
# too where a thing is missing: 6 of 8. On made-up pairs that repeat, aliases have at most a few such points among up to
# a hundred contradicted ones; where a key, a door or some furniture tells a pose from its like, there are tens.
LIKE, MOSTLY, LIKE_REACH = 8, 6, 3.0
ONE_THING = 1.5  # voxel edges within which contradicted points are of one thing: next to each other on the grid
# One point in so many is asked first; where it says that more than so many times as much contradicts the pose as
# explains it, all would say that more does: of some thousand points the share is known to a few hundredths.
SOME, PLAINLY = 4, 1.5
STRETCH_POINTS = 1500  # of the source, on which a change of scale is tried
STRETCH_REACH = 2.5  # voxel edges
STRETCH_SIGMAS = 3.0  # deviations that chance may explain
FLOOR = 0.01  # offsets in voxel edges, and turns: less than that is as good as none


@dataclass(frozen=True)
class Agreement:
    """What two surfaces say of a pose, both ways taken together.

    explained, contradicted: points, of both. missing: of the contradicted ones, those in the midst of others: a thing
        that one scan has and the other one lacks. largest: of the contradicted ones, those of the largest cluster of
        each scan: it stands out even where the thing is too small for points in its midst.
    overlap: share of the smaller scan within TOUCHING of the other one.
    explained_share: the same, of points that are explained.
    inlier_rmse: how far touching points lie off each other's tangent planes, root mean square, own unit. It hardly
        grows with the voxel edge, as the distance to the next point would.
    offset: the same over how far a surface's own neighbours do. turn: the mean of 1 - |cosine| between their normals,
        over the same. Both are about 1 or less where the scans are samples of one surface, whatever its curvature and
        noise.
    detail: points, of both, that are explained and lie on none of the three planes of their largest corner: what a
        mere corner, which fits any other, lacks.
    stretch: by how much the source would have to grow or shrink to fit better, as a share, beyond what chance explains.
    """

    explained: int
    contradicted: int
    missing: int
    largest: int
    overlap: float
    explained_share: float
    inlier_rmse: float
    offset: float
    turn: float
    detail: int
    stretch: float


def agreement(source: Surface, target: Surface, T_target_source: np.ndarray) -> Agreement:
    """Compare two surfaces on the same voxel edge at a pose between their frames.

    Of a pose that is more contradicted than explained, which the verdict denies whatever else there is, no cluster is
    sought: all that contradicts it counts as missing, in one thing, and nothing as detail. Where one point in SOME says
    that plainly, the others are not asked.
    """
    for every in (SOME, 1):
        seen = both_ways(source, target, T_target_source, every)
        sums = np.sum([way.sums for way in seen], 0)
        if sums[1] > PLAINLY * sums[0]:
            break
    denied, detail = sums[1] > sums[0], 0.0
    explained, contradicted = round(every * sums[0]), round(every * sums[1])
    missing = largest = contradicted if denied else 0
    for way in [] if denied else seen:
        x, judged = way.points, way.explained | way.contradicted
        missing += amid_their_like(x[judged], way.contradicted[judged], LIKE_REACH * target.edge)
        largest += int(in_one_thing(x[way.contradicted], target.edge).sum())
        on = way.explained
        detail += on.sum() * share_beyond_corner(x[on], way.normals[on], target.edge, np.random.default_rng(0))
    off2, own_off2, turns, own_turns = sums[3:] / max(sums[2], 1.0)
    return Agreement(
        explained=explained,
        contradicted=contradicted,
        missing=missing,
        largest=largest,
        overlap=float(max(way.sums[2] / way.asked for way in seen)),
        explained_share=float(max(way.sums[0] / way.asked for way in seen)),
        inlier_rmse=float(np.sqrt(off2)) * target.edge if sums[2] else float("inf"),
        offset=float(np.sqrt((off2 + FLOOR**2) / (own_off2 + FLOOR**2))),
        turn=float((max(turns, 0) + FLOOR) / (own_turns + FLOOR)),
        detail=round(detail),
        stretch=stretch(source, target, T_target_source),
    )


@dataclass
class Way:
    """What one surface says of the other one.

    size: its points; asked: those of them that are asked. sums (7,): how many are explained, contradicted, touching; of
    those that touch, the squares of their offsets and of the surface's own, 1 - |cosine| and the surface's own. Of its
    points that are near, (N,): index, which they are; where they are in the other's frame (N, 3), the normals there
    (N, 3), which are explained and which contradicted.
    """

    size: int
    asked: int
    sums: np.ndarray
    index: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    explained: np.ndarray
    contradicted: np.ndarray


def both_ways(source: Surface, target: Surface, T_target_source: np.ndarray, every: int) -> list[Way]:
    """What one point in ``every`` of each surface says of the other one at a pose."""
    found = []
    for a, b, T in ((source, target, T_target_source), (target, source, np.linalg.inv(T_target_source))):
        moved, solid = transform_points(T, a.points[::every]), a.solid[::every]
        distance, index = b.tree.query(moved, distance_upper_bound=REACH * b.edge)
        near = np.isfinite(distance) & solid
        near[near] = b.solid[index[near]]
        here = np.flatnonzero(near)
        there, d, own = index[here], distance[here] / b.edge, here * every
        n = b.normals[there]
        off = np.abs(np.einsum("ni,ni->n", moved[here] - b.points[there], n)) / b.edge
        cosine = np.abs(np.einsum("ni,ni->n", a.normals[own] @ T[:3, :3].T, n))
        own_off, own_turn = b.unevenness[0][there] / b.edge, b.unevenness[1][there]
        over = d * d - off * off < OVER**2
        clear = off > np.maximum(CLEAR, UNEVEN * np.maximum(own_off, a.unevenness[0][own] / a.edge))
        explained = over & ~clear & (cosine > FACING)
        touching = d < TOUCHING
        across = touching & (cosine < ACROSS) & (np.maximum(own_turn, a.unevenness[1][own]) < 1 - FACING)
        contradicted = over & (b.lean[there] < AT_BORDER) & (clear | across)
        sums = [
            explained.sum(), contradicted.sum(), touching.sum(), (off[touching] ** 2).sum(),
            (own_off[touching] ** 2).sum(), (1 - cosine[touching]).sum(), own_turn[touching].sum(),
        ]  # fmt: skip
        asked = max(int(solid.sum()), 1)
        found.append(Way(len(a.points), asked, np.array(sums), own, moved[here], n, explained, contradicted))
    return found


def amid_their_like(points: np.ndarray, some: np.ndarray, reach: float) -> int:
    """How many of ``some`` (N,) of points (N, 3) have MOSTLY their like among the LIKE nearest points within reach."""
    if some.sum() < MOSTLY:
        return 0
    index = cKDTree(points).query(points[some], LIKE, distance_upper_bound=reach)[1]
    return int((np.append(some, False)[index].sum(1) >= MOSTLY).sum())  # index N: nothing so near


def in_one_thing(points: np.ndarray, edge: float) -> np.ndarray:
    """(N,) bool: which of points (N, 3) are of the largest cluster, each within ONE_THING edges of another of it."""
    if not len(points):
        return np.zeros(0, bool)
    near = cKDTree(points).query_pairs(ONE_THING * edge, output_type="ndarray")
    links = coo_matrix((np.ones(len(near), bool), near.T), shape=(len(points), len(points)))
    cluster = connected_components(links, directed=False)[1]
    return cluster == np.bincount(cluster).argmax()


def stretch(source: Surface, target: Surface, T_target_source: np.ndarray) -> float:
    """The scale step, |log s|, of one point-to-plane iteration with scale, less STRETCH_SIGMAS of its deviation."""
    points = source.points[:: max(len(source.points) // STRETCH_POINTS, 1)]
    reach = STRETCH_REACH * target.edge
    found = point_to_plane(points, target.points, target.normals, target.tree, T_target_source, reach, np.zeros(3))
    if found.count < 7:
        return 0.0
    # Schur's complement: what is left for the scale once the six others have taken their best.
    A, b, d = found.A[:6, :6], found.b, found.A[6, :6]
    solved = np.linalg.lstsq(A, np.column_stack([d, b[:6]]), rcond=1e-9)[0]
    information = found.A[6, 6] - d @ solved[:, 0]
    if information <= 1e-9 * found.A[6, 6]:
        return 0.0  # a plane or a sphere about its centre has no scale of its own
    step = abs(b[6] - d @ solved[:, 1]) / information
    return float(max(step - STRETCH_SIGMAS * np.sqrt(found.variance / information), 0.0))
