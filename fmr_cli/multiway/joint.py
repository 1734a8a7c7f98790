"""All scans at once: point-to-plane over every overlapping pair, both ways, solved for all poses together.

What two scans see of each other at the network's poses says more than their link alone: each point-to-plane system is
taken at the common solution, weighted by its own noise, and only in the directions that it determines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.observability import WEAK
from fmr_cli.geometry.point_to_plane import point_to_plane
from fmr_cli.geometry.sampling import sample
from fmr_cli.geometry.se3 import adjoint, exp
from fmr_cli.multiway.pose_graph import EXACT, Prior
from fmr_cli.multiway.workers import Threads
from fmr_cli.registration.prepared import SPACINGS, Prepared

FINER = 2.0  # times the grid on which pairs are registered
REACHES = (1.0, 1.0, 0.7, 0.5)  # of that grid's edges, by round: how far a counterpart may lie; then as the last one
ROUNDS = 20  # at most: what hangs on a narrow view comes near slowly
POINTS = 6_000  # of a scan that are brought onto each of its partners
PARTNERS = 8  # of a scan, those of most overlap first
LEAST = 0.1  # overlap of a pair that takes part
FEW = 100  # counterparts, below which a pair says too little
STILL = 1e-3  # fine edges: a round that moves no scan further ends it
HOLD = 1.0  # edges: sigma that holds the directions which no pair determines where the graph has them


@dataclass(frozen=True)
class View:
    """A scan on the joint refinement's grid, centred: points, normals (M, 3), tree; some: rows brought over."""

    edge: float
    points: np.ndarray
    normals: np.ndarray
    tree: cKDTree
    some: np.ndarray
    radius: float


@dataclass
class Refined:
    """T_component_scan, covariance (6, 6; twist on the right) and point-to-plane residual (file's unit) by scan."""

    T_component_scan: dict[int, np.ndarray]
    covariance: dict[int, np.ndarray]
    residual: dict[int, float]


@dataclass(frozen=True)
class System:
    """Point-to-plane of source onto target: A, b over the twist on the left of T_target_source; variance; count."""

    source: int
    target: int
    A: np.ndarray
    b: np.ndarray
    variance: float
    count: int


def view(scan: Prepared, edge: float) -> View:
    """The scan on voxels of ``edge`` over FINER, or as fine as its spacing allows."""
    fine = min(max(edge / FINER, SPACINGS * scan.spacing), edge)
    surface = scan.surface(fine)
    points = surface.points
    some = sample(np.arange(len(points)), POINTS, np.random.default_rng(scan.seed))
    return View(fine, points, surface.normals, surface.tree, some, float(np.sqrt((points**2).sum(1).mean())))


def partners(
    pairs: Iterable[tuple[int, int]], overlap: Callable[[int, int], float], excluded: set[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Of pairs that may overlap those that share enough, at most PARTNERS a scan but for another's best."""
    shares = {(i, j): overlap(i, j) for i, j in pairs if (i, j) not in excluded}
    kept: set[tuple[int, int]] = set()
    for n in sorted({n for pair in shares for n in pair}):
        mine = sorted((pair for pair in shares if n in pair and shares[pair] >= LEAST), key=lambda p: (-shares[p], p))
        kept.update(mine[:PARTNERS])
    return sorted(kept)


def refine(
    T_component_scan: dict[int, np.ndarray],
    views: dict[int, View],
    pairs: list[tuple[int, int]],
    held: set[int],
    motion: Motion,
    workers: Threads,
    priors: Iterable[Prior] = (),
) -> Refined:
    """The poses at which all pairs fit best at once. held: scans that don't move; priors: poses known beforehand."""
    known = {prior.scan: prior for prior in priors}
    start = {i: T.copy() for i, T in T_component_scan.items()}
    poses = dict(start)
    free = sorted(set(poses) - held)
    place = {i: slice(6 * n, 6 * n + 6) for n, i in enumerate(free)}
    basis = {i: np.kron(np.eye(2), start[i][:3, :3]).T @ motion.basis() for i in free}  # what may move, in i's frame
    covariance, residual = {i: np.zeros((6, 6)) for i in poses}, dict.fromkeys(poses, float("nan"))
    for turn in range(ROUNDS):
        factor = REACHES[min(turn, len(REACHES) - 1)]

        def system(pair: tuple[int, int], factor: float = factor) -> System | None:
            return linearised(
                views[pair[0]], views[pair[1]], *pair, np.linalg.inv(poses[pair[1]]) @ poses[pair[0]], factor
            )

        both = [pair for i, j in pairs for pair in ((i, j), (j, i))]
        systems = [s for s in workers.map(system, both) if s is not None]
        if not systems or not free:
            break
        floor = float(np.median([s.variance for s in systems])) / 9
        H, g = np.zeros((6 * len(free), 6 * len(free))), np.zeros(6 * len(free))
        for s in systems:
            A, b = determined(s.A / max(s.variance, floor), s.b / max(s.variance, floor), views[s.target].radius)
            T = np.linalg.inv(poses[s.target]) @ poses[s.source]
            J = {s.source: adjoint(T), s.target: -np.eye(6)}
            for p in J.keys() & place.keys():
                g[place[p]] += J[p].T @ b
                for q in J.keys() & place.keys():
                    H[place[p], place[q]] += J[p].T @ A @ J[q]
        for i in free:
            edge = HOLD * views[i].edge
            pulls = [(start[i], edge / views[i].radius, edge)]
            if i in known:
                pulls.append((known[i].T_component_scan, known[i].sigma_rot, known[i].sigma_shift))
            for towards, sigma_rot, sigma_shift in pulls:
                hold = np.diag([1 / max(sigma_rot, EXACT) ** 2] * 3 + [1 / max(sigma_shift, EXACT) ** 2] * 3)
                H[place[i], place[i]] += hold
                g[place[i]] += hold @ right_twist(towards, poses[i])
        B = np.zeros((len(H), sum(basis[i].shape[1] for i in free)))
        column = 0
        for i in free:
            B[place[i], column : column + basis[i].shape[1]] = basis[i]
            column += basis[i].shape[1]
        normal = B.T @ H @ B
        step = -B @ np.linalg.solve(normal, B.T @ g)
        for i in free:
            poses[i] = poses[i] @ exp(step[place[i]])
        moved = max(np.linalg.norm(step[place[i]] * ([views[i].radius] * 3 + [1.0] * 3)) / views[i].edge for i in free)
        if factor == REACHES[-1] and moved < STILL:
            break
    if free and systems:
        inflation = max(misfit(systems, floor, views), 1.0) * repetition(systems, views)
        full = inflation * (B @ np.linalg.inv(normal) @ B.T)
        covariance |= {i: full[place[i], place[i]] for i in free}
    for i in poses:
        mine = [s for s in systems if i in (s.source, s.target)] if pairs else []
        if mine:
            residual[i] = float(np.sqrt(sum(s.variance * s.count for s in mine) / sum(s.count for s in mine)))
    return Refined(poses, covariance, residual)


def linearised(source: View, target: View, i: int, j: int, T_target_source: np.ndarray, factor: float) -> System | None:
    """Point-to-plane of a pair at the common solution, or None where they share too little."""
    reach = factor * max(source.edge, target.edge)
    found = point_to_plane(
        source.points[source.some], target.points, target.normals, target.tree, T_target_source, reach, np.zeros(3)
    )
    if found.count < FEW:
        return None
    return System(i, j, found.A[:6, :6], found.b[:6], float(found.variance), int(found.count))


def determined(A: np.ndarray, b: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The system without the directions that the pair hardly determines, WEAK against its strongest."""
    S = np.diag([1 / radius] * 3 + [1.0] * 3)
    values, V = np.linalg.eigh(S @ A @ S)
    kept = np.where(values > WEAK * values[-1], 1.0, 0.0)
    inverse = np.diag([radius] * 3 + [1.0] * 3)
    project = inverse @ (V * kept) @ V.T @ S
    return project @ A @ project.T, project @ b


def misfit(systems: list[System], floor: float, views: dict[int, View]) -> float:
    """By how much pairs contradict each other beyond their noise: the median of b A^-1 b, 1 where they don't.

    A pair alone would move by -A^-1 b. Points err together (bent scans, moving things), so this is often far above 1;
    it multiplies the covariance, as an adjustment's variance of unit weight does.
    """
    ratios = []
    for s in systems:
        A, b = determined(s.A / max(s.variance, floor), s.b / max(s.variance, floor), views[s.target].radius)
        values, V = np.linalg.eigh(A)
        kept = values > 1e-9 * values[-1]
        ratios.append(float((((V[:, kept].T @ b) ** 2) / values[kept]).sum() / max(kept.sum(), 1)))
    return float(np.median(ratios))


def repetition(systems: list[System], views: dict[int, View]) -> float:
    """By how much the normal equations count the same noise again; it multiplies the covariance.

    Each pair is taken both ways, so that every residual stands in them twice. And a point's own noise goes into its
    residuals against all k partners that see it, which the equations take for independent. Of k + 1 scans of one
    surface, n points each with noise s², all k (k + 1) / 2 differences alike, least squares puts one scan against
    another with a variance of 2 s² / n, whatever k; the equations, their pairs counted twice, say 2 s² / (n (k + 1)).
    So k + 1, with k the mean over all points.
    """
    seen: dict[int, float] = {}
    for s in systems:
        seen[s.source] = seen.get(s.source, 0.0) + s.count / len(views[s.source].some)
    weights = np.array([s.count for s in systems], float)
    partners = np.average([max(seen[s.source], 1.0) for s in systems], weights=weights)
    return float(partners + 1)


def right_twist(start: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """To first order, the twist on the right of ``start`` that leads to ``pose``; both (4, 4), near each other."""
    D = np.linalg.inv(start) @ pose
    omega = np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]) / 2
    return np.concatenate([omega, D[:3, 3]])
