"""From a hypothesis to a pose: the feature metric of local patches, then geometry, coarse to fine.

Poses are between the centred frames of a ``Pair``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.inverse_compositional import constrained_step
from fmr_cli.feature_metric.patches import Neighbourhoods, patch_template, refine
from fmr_cli.geometry.counterparts import counterparts, in_strips
from fmr_cli.geometry.gicp import GicpCloud, gicp, observed
from fmr_cli.geometry.observability import Observations
from fmr_cli.geometry.planar import within_plane
from fmr_cli.geometry.point_to_plane import constrained, face_along, point_to_plane, step_motion, with_scale
from fmr_cli.geometry.sampling import sample
from fmr_cli.geometry.smoothing import NEAR, Roughness, local_planes
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration.hypotheses import Hypothesis
from fmr_cli.registration.pair import Pair
from fmr_cli.registration.prepared import LARGE, MIN_POINTS, SPACINGS

LEVELS = ((12.0, 2.0), (6.0, 1.0))  # patch radius and grid, in voxel edges, coarse to fine; GICP does the rest
FINE = LEVELS[1:]
PATCHES, PATCH_ITERATIONS, BALL_POINTS = 96, 5, 128  # patches on the overlap, IC iterations, points of a patch
# Voxel edges, a step each: first on a few points from anywhere, which tells most hypotheses that lead nowhere; then on
# more of the common region.
ROUGH_REACHES, ROUGH_POINTS = (4.0, 3.0, 2.0, 1.5), 400
FINE_REACHES, PLANE_POINTS = (3.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.7), 800
COMMON_REACH = 4.0  # voxel edges: points nearer than that to the other surface may be of the common region
DAMPING = 1e-6  # of the diagonal: directions that the overlap does not determine stay where they are
GICP_TARGET, GICP_SOURCE = 24_000, 8_000  # points, at most: more cost time and gain nothing measurable
# Tried on RedKitchen scans, by hand: roughness 0.22 at 1 % noise, below 0.08 without; 30 neighbours best of 10 to 50.
ROUGH, CLEAN, SMOOTHED_OVER = 0.12, 0.08, 30
NOISE_GROWTH = (SMOOTHED_OVER / NEAR) ** 0.5  # of the deviation from the small planes to the wide ones, at most
SMOOTHED_REACHES = (1.0, 1.0, 0.7, 0.7, 0.5, 0.5)  # voxel edges, a step each
GICP_REACH = 3.0  # voxel edges: source points further from the target slow its k-d tree down, by up to 500 times
FINER = 4.0  # times as fine is the grid of the last step on large clouds, where they are dense enough
STRIPS = 8  # across the target, in which that is looked at
STRIP_MARGIN = 3.0  # fine voxels: as far as the neighbours reach that give a point its covariance


@dataclass(frozen=True)
class Polished:
    """A pose; observed: what it was found by, where that is known better than by the voxels.

    Of other steps than GICP the voxels say it: smoothing takes the noise out of the residuals too.
    """

    T_target_source: np.ndarray
    observed: Callable[[], Observations | None] = lambda: None


def roughly(pair: Pair, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Where hypotheses lead to, near enough to tell by their scores which are worth more: cheap."""
    if not hypotheses:
        return []
    T = [pair.motion.exact(h.T_target_source) for h in hypotheses]
    # Where the global feature leads to is only roughly right.
    T = [by_patches(pair, t, LEVELS) if h.errors else t for t, h in zip(T, hypotheses, strict=True)]
    if pair.options.refine:
        T = list(by_few_planes(pair, np.array(T)))
    return [replace(h, T_target_source=t, score=pair.overlap_score(t)) for t, h in zip(T, hypotheses, strict=True)]


def refined(pair: Pair, hypotheses: Sequence[Hypothesis]) -> list[np.ndarray]:
    """The poses that hypotheses lead to, near enough to be judged."""
    T = [pair.motion.exact(h.T_target_source) for h in hypotheses]
    if not pair.options.refine:
        return [t if h.errors else by_patches(pair, t, FINE) for t, h in zip(T, hypotheses, strict=True)]
    return list(by_common_planes(pair, np.array(T))) if T else []


def by_patches(
    pair: Pair, T_target_source: np.ndarray, levels: tuple[tuple[float, float], ...], both: bool = False
) -> np.ndarray:
    """The pose after the feature metric of local patches, from coarse to fine; by one Jacobian or ``both``."""
    length = pair.boxes[1].unit
    g = T_target_source.copy()
    g[:3, 3] /= length
    for radius, coarseness in levels:
        s, t = (cloud.surface(pair.edge * coarseness) for cloud in (pair.source, pair.target))
        reach = radius * pair.edge
        centres = patch_centres(pair, s, t, g, reach) / length
        template = patch_template(pair.encoder.layers, centres, balls(t, reach, length), reach / length)
        look = balls(s, reach, length)
        g = refine(pair.encoder.layers, template, look, g, PATCH_ITERATIONS, pair.motion.basis(), both).g
    g[:3, 3] *= length
    return g


def patch_centres(pair: Pair, s: Surface, t: Surface, g: np.ndarray, reach: float) -> np.ndarray:
    """Points of the target, spread evenly, that the source comes near to at g: (P, 3)."""
    some = sample(t.points, 6 * PATCHES, np.random.default_rng(pair.seed))
    back = (some - g[:3, 3] * pair.boxes[1].unit) @ g[:3, :3]
    common = some[np.isfinite(s.tree.query(back, distance_upper_bound=reach / 2)[0])]
    return (common if len(common) >= 8 else some)[:PATCHES]


def balls(surface: Surface, radius: float, length: float) -> Neighbourhoods:
    """Look-ups for ``feature_metric.patches``: centres in units of ``length``, balls of ``radius`` (own unit)."""

    def look(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return surface.around(centres * length, radius, BALL_POINTS)[:2]

    return look


def by_planes(pair: Pair, T_target_source: np.ndarray) -> np.ndarray:
    """The pose after robust point-to-plane steps on a few voxels, from far to near: what a hypothesis is judged at."""
    return by_common_planes(pair, by_few_planes(pair, T_target_source[None]))[0]


def by_few_planes(pair: Pair, T_target_source: np.ndarray) -> np.ndarray:
    """The poses (n, 4, 4) after a few steps on few points."""
    points, facing = (x[:ROUGH_POINTS] for x in pair.some)  # in random order
    return by_steps(pair, T_target_source, points, facing, ROUGH_REACHES)


def by_common_planes(pair: Pair, T_target_source: np.ndarray) -> np.ndarray:
    """The poses (n, 4, 4) after steps on the common region: at small overlap what only one scan saw would pull."""
    return by_steps(pair, T_target_source, *common_points(pair, T_target_source), FINE_REACHES)


def by_steps(
    pair: Pair, T_target_source: np.ndarray, points: np.ndarray, facing: np.ndarray, reaches: tuple[float, ...]
) -> np.ndarray:
    """The poses (n, 4, 4) after a robust point-to-plane step for each reach (voxel edges), onto what faces along.

    points, facing: of the source, and their normals, ([n,] N, 3). A pose that has too few partners stays where it is.
    """
    scale = pair.options.scale
    basis, T, pivot = with_scale(pair.motion.basis(), scale), T_target_source, np.zeros(3)
    free, going = len(basis), np.ones(len(T), bool)
    for reach in reaches:
        normal = point_to_plane(points, pair.t.points, pair.t.normals, pair.t.tree, T, reach * pair.edge, pivot, facing)
        going &= normal.count >= MIN_POINTS
        A, b = normal.A[:, :free, :free], normal.b[:, :free]
        step = constrained_step(A * (1 + DAMPING * np.eye(free)), -b, basis)
        T = np.where(going[:, None, None], step_motion(step) @ T, T)
    return T


def common_points(pair: Pair, T_target_source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A few of the source's points that come near the target at each pose (n, 4, 4), and their normals: (n, N, 3) each.

    Where there are fewer than N, the rest have no normal, which faces along with nothing.
    """
    moved = transform_points(T_target_source, pair.s.points)
    reach = COMMON_REACH * pair.edge
    near = np.isfinite(pair.t.tree.query(moved, distance_upper_bound=reach, workers=pair.threads)[0])
    both = np.hstack([pair.s.points, pair.s.normals])
    some = [sample(both[here], PLANE_POINTS, np.random.default_rng(pair.seed)) for here in near]
    found = np.zeros((len(some), max(map(len, some)), 6))
    for row, each in zip(found, some, strict=True):
        row[: len(each)] = each
    return found[..., :3], found[..., 3:]


def by_geometry(pair: Pair, T_target_source: np.ndarray) -> Polished:
    """The pose after GICP, or after point-to-plane within the options' motions and scale."""
    edge = pair.edge
    s, t = pair.both(lambda cloud, count: cloud.fine(count, edge), (GICP_SOURCE, GICP_TARGET))
    if pair.options.scale or pair.motion.dof != "rigid":
        return Polished(constrained(s, t, T_target_source, edge, pair.motion.basis(), pair.options.scale))
    rough = noisy(pair)
    if not rough and (fine := finer_edge(pair)):
        return on_finer_voxels(pair, T_target_source, fine)
    found = gicp_in_reach(pair, s, pair.target.for_gicp(GICP_TARGET, edge, pair.threads), T_target_source)
    if rough:
        T = found.T_target_source
        any_motion = np.eye(6)
        clean_source, clean_target = (cloud.share < CLEAN for cloud in roughnesses(pair))
        if clean_target:  # onto a clean scan's own planes, which smoothing would bend
            T = constrained(s, t, T, edge, any_motion, False)
        elif clean_source:
            T = np.linalg.inv(constrained(t, s, np.linalg.inv(T), edge, any_motion, False))
        else:
            T = by_smoothed(pair, T, s, t)
        found = Polished(T)
    planes = pair.flat_planes
    return found if planes is None else Polished(within_plane(found.T_target_source, *planes))


def finer_edge(pair: Pair) -> float | None:
    """The voxel edge of the finer grid that two large scans are dense enough for, if they are."""
    source, target = pair.source, pair.target
    fine = max(pair.edge / FINER, SPACINGS * source.spacing, SPACINGS * target.spacing)
    large = min(len(source.points), len(target.points)) > LARGE
    return fine if large and fine <= pair.edge / 2 else None


def on_finer_voxels(pair: Pair, T_target_source: np.ndarray, fine: float) -> Polished:
    """The pose after GICP on voxels of edge ``fine``, each the mean of many points, in strips of the scans.

    As many voxels from anywhere would be as exact, but would need all of the target's to be looked at.
    """
    s, t = pair.both(lambda cloud: cloud.thinned(fine))
    period, margin = 2 * pair.target.reach / STRIPS, STRIP_MARGIN * fine
    share = GICP_SOURCE / max(len(s), GICP_SOURCE) + 2 * margin / period
    s, t = in_strips(s, t, T_target_source, period, share, margin)
    return by_gicp(GicpCloud(s, fine, pair.threads), GicpCloud(t, fine, pair.threads), T_target_source, fine)


def noisy(pair: Pair) -> bool:
    """Whether the points of a cloud scatter about its surface by more than GICP's small neighbourhoods even out.

    Not where they are so sparse that their neighbourhoods show its shape: wider ones would cut its corners.
    """
    rough = [cloud.growth for cloud in roughnesses(pair) if cloud.share > ROUGH]
    return bool(rough) and max(rough) < NOISE_GROWTH


def roughnesses(pair: Pair) -> list[Roughness]:
    """Of source and target."""
    counts = GICP_SOURCE, GICP_TARGET
    return pair.both(lambda cloud, count: cloud.roughness(count, pair.edge, SMOOTHED_OVER), counts)


def by_smoothed(pair: Pair, T_target_source: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The pose after point-to-plane steps between points put onto planes through many neighbours.

    Noise averages out over a neighbourhood; points are put onto planes rather than averaged, so that two samplings of
    one surface stay on it. On clean scans so wide a plane would cut corners, and GICP is as exact.
    """
    source = local_planes(source, cKDTree(source), SMOOTHED_OVER)[0]
    target, normals, _ = local_planes(target, cKDTree(target), SMOOTHED_OVER)
    tree, T = cKDTree(target), T_target_source
    for reach in SMOOTHED_REACHES:
        normal = point_to_plane(source, target, normals, tree, T, reach * pair.edge, np.zeros(3))
        if normal.count < MIN_POINTS:
            return T_target_source
        T = step_motion(-np.linalg.lstsq(normal.A[:6, :6], normal.b[:6], rcond=1e-10)[0]) @ T
    return T


def gicp_in_reach(pair: Pair, source: np.ndarray, target: GicpCloud, T_target_source: np.ndarray) -> Polished:
    """GICP of those of the source's points that are in reach of the target and face along with it."""
    moved, t = transform_points(T_target_source, source), pair.t
    distance, beside = t.tree.query(moved, distance_upper_bound=GICP_REACH * pair.edge, workers=pair.threads)
    near = np.flatnonzero(np.isfinite(distance))
    normals = pair.s.normals[pair.s.tree.query(source[near], workers=pair.threads)[1]] @ T_target_source[:3, :3].T
    near = source[near[face_along(normals, t.normals[beside[near]])]]
    if len(near) < MIN_POINTS:
        return Polished(T_target_source)
    return by_gicp(GicpCloud(near, pair.edge, pair.threads), target, T_target_source, pair.edge)


def by_gicp(source: GicpCloud, target: GicpCloud, T_target_source: np.ndarray, edge: float) -> Polished:
    """The pose after GICP between two clouds on voxels of ``edge``."""
    T = gicp(source, target, T_target_source, edge)
    return Polished(T, partial(observed, source, target, T, edge))


def exact(pair: Pair, polished: Polished) -> Polished:
    """The pose by the points that large scans have in common, if most have: these come to coincide, point by point."""
    source, target = pair.source, pair.target
    other_motion = pair.options.scale or pair.motion.dof != "rigid"
    if other_motion or len(target.points) <= GICP_TARGET or pair.flat_planes is not None or noisy(pair):
        return polished  # what the step before did for these, this would undo
    common = counterparts(
        source.points, target.points, polished.T_target_source, target.spacing, target.reach, pair.seed
    )
    return Polished(common.T_target_source, common.observed) if common else polished
