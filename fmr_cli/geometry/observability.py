"""Which directions of a pose two scans determine, and how well."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.kernels import NORMAL, geman_mcclure, geman_mcclure_slope
from fmr_cli.geometry.point_to_plane import SCALE, linearise, normal_equations
from fmr_cli.geometry.se3 import adjoint
from fmr_cli.geometry.surface import Surface
from fmr_cli.geometry.voxels import voxel_keys

WEAK = 2e-3  # of the strongest direction's information: what the noise of the normals alone pretends to
# The same of a whole pair, for how far a direction moves the scan: of spheres, cylinders and corridors of 2,000 points
# and more up to 0.0045, of right pairs of the street of `python -m benchmarks.multiway` from 0.010.
HARDLY = 5e-3
# But for what surfaces oppose (``unopposed``): a direction that as many voxels of both scans face, by more than SURELY
# deviations of what the normals' errors would say, is determined, however many others say nothing. On made-up pairs up
# to 2 voxels along tunnels and walls, about spheres and bottles; along facades and corridors, by the sides of their
# windows and doors, 7 to 230.
OPPOSED, SURELY = 5.0, 3.0
REACH = 1.5  # voxel edges: correspondences further apart are no observations
BLOCK = 8.0  # voxel edges: residuals within a block are taken to be correlated, those of two blocks not
ROUNDING = 1e-6  # voxel edges: copies fit to it, and their pose is known no better
BENDS = 8.0  # independent parts of a scan that is bent or drifted as a whole: half an extent each
# Counted as left of a direction without a block: without the one block that alone holds it, nothing would be.
LEFT = 1e-3
BIAS = 1.0  # points' sigmas: of a range bias, beforehand; sensors' data sheets give accuracy and noise of one size
EXPECTED = 6.0  # of the squared distance between a pose and another estimate of it, in deviations: one a direction
LEAST_BLOCKS = 8  # fewer say nothing about the scatter of their sums


@dataclass(frozen=True)
class Observations:
    """What a pose is held by: points of the source, where it puts them, drawn onto planes through points of the target.

    x, y: the points, normal: of the planes, unit; (N, 3) in the target's frame. weight: w of a residual r = n·(x - y),
    at most 1; slope: of its pull w r by r; (N,).
    """

    x: np.ndarray
    y: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class Certainty:
    """How well a pose is determined; twists (rotation, translation), rad and own unit.

    information: (6, 6), as if every voxel were an observation of its own: tells which directions are determined at
    all. covariance: (6, 6), of the pose, over the directions that are.
    """

    information: np.ndarray
    covariance: np.ndarray


def certainty(
    source: Surface,
    target: Surface,
    T_target_source: np.ndarray,
    origin: np.ndarray,
    noise: Sequence[float] = (0.0, 0.0),
    eyes: Sequence[np.ndarray | None] = (None, None),
    polish: Observations | None = None,
) -> Certainty:
    """Of the twist in the target's frame about ``origin`` (3,), by point-to-plane at a pose.

    noise: the deviation of single points of source and target from their surface, own unit. eyes: (3,) where their
    sensors were, each in its own frame, None where that isn't known: the middle of the points then, as a scanner that
    looks all round has it. polish: what the pose was found by last, if by anything finer than the voxels: its error is
    that of these residuals.
    """
    seen, misfit = voxels(source, target, T_target_source)
    if not len(seen.x):
        return Certainty(np.zeros((6, 6)), np.zeros((6, 6)))
    r, J = linearise(seen.x, seen.y, seen.normal, origin)
    information = normal_equations(J, r, seen.weight)[0] / 2 / variance_of(r, seen.weight, target.edge)
    source_eye, target_eye = (
        cloud.points.mean(0) if eye is None else eye for cloud, eye in zip((source, target), eyes, strict=True)
    )
    source_eye = transform_points(T_target_source, source_eye[None])[0]
    by = seen if polish is None or not len(polish.x) else polish
    outward = np.stack([outwards(by.x, by.normal, source_eye), -outwards(by.y, by.normal, target_eye)])
    return Certainty(information, covariance(by, origin, target.edge, misfit, outward, np.asarray(noise)))


def voxels(source: Surface, target: Surface, T_target_source: np.ndarray) -> tuple[Observations, float]:
    """What the voxels observe at a pose, both ways, and the mean square of their misfit beyond their own roughness."""
    seen, misfits = [], [0.0]
    placed = transform_points(T_target_source, source.points)
    for i, j, onto_target in partners(source, target, T_target_source):
        if not len(i):
            continue
        x, y = placed[i], target.points[j]
        n = target.normals[j] if onto_target else source.normals[i] @ T_target_source[:3, :3].T
        own = target.unevenness[0][j] if onto_target else source.unevenness[0][i]
        r = np.einsum("ni,ni->n", n, x - y)
        scale2 = (SCALE * np.median(np.abs(r))) ** 2 + (1e-9 * target.edge) ** 2
        seen.append(np.column_stack([x, y, n, geman_mcclure(r * r, scale2), geman_mcclure_slope(r * r, scale2)]))
        misfits.append(NORMAL**2 * (np.median(np.abs(r)) ** 2 - np.median(own) ** 2))
    x, y, n, both = np.split(np.vstack(seen) if seen else np.zeros((0, 11)), (3, 6, 9), axis=1)
    return Observations(x, y, n, *both.T), max(sum(misfits), 0.0) / 2


def variance_of(r: np.ndarray, weight: np.ndarray, edge: float) -> float:
    """Of weighted residuals (N,), own unit squared."""
    return max(float(weight @ (r * r) / max(weight.sum(), 1e-12)), (ROUNDING * edge) ** 2)


def covariance(
    seen: Observations, origin: np.ndarray, edge: float, misfit: float, outward: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Of a pose (6, 6) that is held by these observations; origin and noise as for ``certainty``.

    edge: of the voxels; misfit: as ``voxels`` give it; outward (2, N): as for ``range_bias``.

    It is that of a robust estimate of correlated observations (Huber's sandwich, by blocks: Liang and Zeger 1986). With
    the pull ψ = w r of a residual and its slope ψ' by r, D = Σ ψ' J Jᵀ and g_b = Σ ψ J over block b of neighbouring
    points, it is D⁻¹ (Σ g_b g_bᵀ) D⁻¹, however the residuals within a block hang together, be it by noise that points
    share or by a surface that is bent. Each g_b is divided by the root of what the block itself leaves of its square
    (I - D_b D⁻¹), since the pose follows a block that alone holds a direction: without bias where the residuals are of
    one size (Bell and McCaffrey 2002), while the jackknife, without the root, has 1.1 times the variance on made-up
    scans. Where the residuals' own optimum lies further from the pose than this covariance allows, the step to it
    counts as a deviation along its own direction, and the others are none the worse for it. A misfit beyond the
    surfaces' own roughness, as of scans that are bent or drifted, is the same over large parts, of which there are
    BENDS.
    """
    r, J = linearise(seen.x, seen.y, seen.normal, origin)
    A, w = normal_equations(J, r, seen.weight)[0], seen.weight
    variance = variance_of(r, w, edge)
    units = np.sqrt(np.maximum(np.diag(A), 1e-300))  # radians and lengths compare once each is divided by its own
    J = J / units[:, None]
    inverse = pseudo_inverse(A / np.outer(units, units))
    block, index = np.unique(voxel_keys(seen.y, BLOCK * edge), return_inverse=True)
    found = inverse * w.sum() * (misfit / BENDS + (ROUNDING * edge) ** 2)
    found += range_bias(J, outward, w, r, inverse, variance, BIAS * noise, len(r) / len(block))
    if len(block) >= LEAST_BLOCKS:
        found += sandwich(J, w * r, seen.slope, index)
    else:
        found += inverse * variance
    return found / np.outer(units, units)


def partners(
    source: Surface, target: Surface, T_target_source: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Rows of source and target (n,) that lie next to each other, seen from the source and then from the target.

    Each way the nearest point within REACH of each solid one; True where the source's points are put onto the target.
    """
    back = np.linalg.inv(T_target_source)
    for a, b, T, onto_target in ((source, target, T_target_source, True), (target, source, back, False)):
        distance, match = b.tree.query(transform_points(T, a.points), distance_upper_bound=REACH * b.edge)
        here = np.flatnonzero(np.isfinite(distance) & a.solid)
        yield (here, match[here], True) if onto_target else (match[here], here, False)


def outwards(points: np.ndarray, normals: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """How far points (N, 3) move along their normals where all move one unit away from an eye (3,)."""
    away = points - eye
    return np.einsum("ni,ni->n", away, normals) / np.maximum(np.linalg.norm(away, axis=1), 1e-300)


def range_bias(
    J: np.ndarray,
    outward: np.ndarray,
    w: np.ndarray,
    r: np.ndarray,
    inverse: np.ndarray,
    variance: float,
    sigma: np.ndarray,
    together: float,
) -> np.ndarray:
    """What ranges that are all too long or too short by one length add to a pose's covariance (6, 6).

    The biases are parameters that the pose was found without (Schmidt's consider parameters): J (6, N) and outward
    (2, N; of source and target) are the residuals' derivatives. How large they are the residuals tell, where surfaces
    face each other, as both sides of a street; where they don't, no more than sigma (2,; of source and target) is
    known. inverse: (6, 6) of Σ w J Jᵀ; variance: of a residual; together: how many of them are one observation.
    """
    cross = (J * w) @ outward.T
    to_pose = inverse @ cross
    known = (outward * w) @ outward.T - cross.T @ to_pose
    pull = outward @ (w * r) - to_pose.T @ (J @ (w * r))
    before = np.diag(variance / np.maximum(sigma**2, 1e-12 * variance))
    spread = np.linalg.inv(known / together + before)  # in units of the residuals' variance
    bias = spread @ pull / together
    return to_pose @ (variance * spread + np.outer(bias, bias)) @ to_pose.T


def sandwich(J: np.ndarray, pull: np.ndarray, slope: np.ndarray, block: np.ndarray) -> np.ndarray:
    """The covariance (6, 6) of a robust estimate; see ``covariance``. J (6, N); the others (N,), block from 0 up."""
    count = int(block.max()) + 1
    pairs = np.stack([a * b * slope for a in J for b in J])
    D_b = np.stack([np.bincount(block, row, count) for row in pairs], 1).reshape(count, 6, 6)
    g_b = np.stack([np.bincount(block, row, count) for row in J * pull], 1)
    inverse = pseudo_inverse(D_b.sum(0))
    step = inverse @ g_b.sum(0)
    values, axes = np.linalg.eigh(inverse)
    half = (axes * np.sqrt(np.maximum(values, 0))) @ axes.T  # D^-1/2, in whose units what a block leaves is symmetric
    left, axes = np.linalg.eigh((1 + LEFT) * np.eye(6) - half @ D_b @ half)
    along = np.einsum("bji,bj->bi", axes, (g_b - D_b @ step) @ half) / np.sqrt(np.maximum(left, LEFT))
    g_b = np.einsum("bij,bj->bi", axes, along) @ half
    found = g_b.T @ g_b * (count - 1) / count
    square = float(step @ pseudo_inverse(found) @ step)
    return found + np.outer(step, step) * max(1 - EXPECTED / max(square, EXPECTED), 0.0)


def pseudo_inverse(A: np.ndarray) -> np.ndarray:
    """Of a symmetric matrix, without the directions that rounding alone holds."""
    return np.linalg.pinv(A, rcond=1e-9, hermitian=True)


def about(information: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The information (6, 6) of the twist about the origin as that of the twist about ``centre`` (3,)."""
    T_centre_origin = np.eye(4)
    T_centre_origin[:3, 3] = -centre
    return in_frame(information, T_centre_origin)


def in_frame(information: np.ndarray, T_b_a: np.ndarray) -> np.ndarray:
    """The information (6, 6) of a twist in frame a, about its origin, as that of the twist in frame b, about b's."""
    M = adjoint(np.linalg.inv(T_b_a))
    return M.T @ information @ M


def weak_twists(info: np.ndarray, points: np.ndarray, basis: np.ndarray | None = None) -> np.ndarray:
    """The twists (6, k) that the scans hardly determine: those that are HARDLY anything against the strongest.

    Motions compare by how far they move a scan's points, root mean square, which is 1 for each of these: along a street
    a roll moves them little. info: (6, 6) of the twist about the scan's centre; points (N, 3): of the scan, about its
    centre, in the same axes; basis: (6, d) orthonormal twists that the motion may use, None for all six.
    """
    B = np.eye(6) if basis is None else basis
    second = points.T @ points / len(points)
    moved = np.eye(6)  # mean square displacement of the points by a twist x is xᵀ moved x
    moved[:3, :3] = np.trace(second) * (1 + 1e-6) * np.eye(3) - second
    values, vectors = eigh(B.T @ info @ B, B.T @ moved @ B)
    return (B @ vectors)[:, values <= HARDLY * max(values[-1], 1e-300)]


def unopposed(
    twists: np.ndarray, source: Surface, target: Surface, T_target_source: np.ndarray, centre: np.ndarray
) -> np.ndarray:
    """Of twists (6, k) in the target's frame about ``centre`` (3,), each 1 long: those that no surface opposes (6, j).

    How far a voxel moves along its normal, by the source's normal times by the target's: the errors of the two have
    nothing to do with each other and cancel in the sum, where one normal's own square would add up to a pretence of
    information (instrumental variables). Every voxel counts alike: the few that hold a direction, as windows' sides
    along a facade, are those that a robust weight takes for outliers of a flat wall.
    """
    along, placed = [], transform_points(T_target_source, source.points)
    for i, j, onto_target in partners(source, target, T_target_source):
        solid = source.solid[i] & target.solid[j]
        i, j = i[solid], j[solid]
        x = placed[i] if onto_target else target.points[j]
        own, other = source.normals[i] @ T_target_source[:3, :3].T, target.normals[j]
        other = other * np.sign(np.einsum("ni,ni->n", own, other))[:, None]
        along.append([linearise(x, x, n, centre)[1].T @ twists for n in (own, other)])
    own, other = np.concatenate(along, 1)  # (N, k) each
    both = own.T @ other
    values, turn = np.linalg.eigh((both + both.T) / 2)
    chance = np.sqrt((((own @ turn) * (other @ turn)) ** 2).sum(0))
    opposed = values > np.maximum(OPPOSED, SURELY * chance)
    return (twists @ turn)[:, ~opposed] if opposed.any() else twists


def in_words(twists: np.ndarray) -> list[str]:
    """Twists (6, k) as what the scans do not determine."""
    said = []
    for vector in twists.T:
        omega, v = vector[:3], vector[3:]
        turns = v @ v < 0.5  # of the mean square displacement: it turns more than it shifts
        axis = omega if turns else v
        kind = "rotation about" if turns else "shift along"
        said.append(f"{kind} {direction(axis)}")
    return said


def direction(v: np.ndarray) -> str:
    """A direction (3,) in words, its largest component positive."""
    v = v / max(float(np.linalg.norm(v)), 1e-300)
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(v, 2) + 0.0))  # no -0.00
