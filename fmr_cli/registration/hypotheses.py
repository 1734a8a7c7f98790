"""Where the pose of a pair may be: hypotheses from local features, from the search over rotations, from given poses.

Poses are between the centred frames of a ``Pair``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.descriptors.consensus import consensus
from fmr_cli.feature_metric.search import STARTS, search
from fmr_cli.geometry.motion import Motion
from fmr_cli.registration.pair import CONSENSUS_TOLERANCE, Pair

CONSENSUS_POSES = 10  # poses that matches agree on, at most
RUNNERS_UP = 3  # of the other cloud's keypoints, after the one that a match goes to
ELSEWHERE = 4.0  # voxel edges: a runner-up nearer to the match shows the same place
RIVAL_SHARE = 0.08  # of the matches behind a pose that must have their like behind a rival
RIVAL_MATCHES = 4  # at least: fewer agree by chance
RIVAL_SCORE = 0.35  # of the pose's own overlap score, that a rival has at least
HALF_TURNED = 0.7  # likewise, of a half-turn: an object's that is symmetric has all of it, flat ground half and more
RIVALS = 12  # at most: of a longer row, the nearest
ORBIT = 24  # poses tried along what maps a cloud onto itself: a gear's turns, both ways along a facade


@dataclass
class Hypothesis:
    """A pose that may be right, before it is refined.

    start: the kind of start it came from. score: its ``Pair.overlap_score``. errors: mean |F(g Q) - F(P)| of each
    iteration where the IC solver led to it, else empty.
    """

    T_target_source: np.ndarray
    start: str
    score: float = 0.0
    errors: list[float] = field(default_factory=list)


def from_features(pair: Pair) -> list[Hypothesis]:
    """Matched local features and their spatial consensus: any rotation, part overlap."""
    return from_matches(pair, *pair.matches)


def from_matches(pair: Pair, x: np.ndarray, y: np.ndarray) -> list[Hypothesis]:
    """The spatial consensus of matches of source and target points x, y (C, 3)."""
    return [Hypothesis(T, "features", pair.overlap_score(T)) for T in agreed(pair, x, y)[0]]


def agreed(pair: Pair, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 4, 4) that matches of source and target points x, y (C, 3) agree on, and how many do (n,)."""
    motion = Motion(pair.motion.dof, pair.motion.up, pair.motion.lift / pair.edge)
    poses, counts = consensus(x / pair.edge, y / pair.edge, CONSENSUS_TOLERANCE, CONSENSUS_POSES, motion)
    poses[:, :3, 3] *= pair.edge
    return poses, counts


def from_search(pair: Pair) -> list[Hypothesis]:
    """The global feature from rotations spread over all that are allowed: any rotation, full overlap."""
    starts = pair.motion.starts(STARTS)
    if pair.motion.dof == "planar":  # all starts lie at the height that the motion keeps
        starts[:, :3, 3] = (pair.enter_box(pair.motion.exact(np.eye(4)))[:3, 3] @ pair.motion.up) * np.array(
            pair.motion.up
        )
    Q, P = pair.sampled
    found = search(pair.solver, Q, P, starts, pair.options.robust, pair.motion.basis(), pair.threads)
    poses = [(pair.leave_box(g), errors.tolist()) for g, errors in zip(found.g, found.errors.T, strict=True)]
    return [Hypothesis(T, "search", pair.overlap_score(T), errors) for T, errors in poses]


def from_pose(pair: Pair, T_target_source: np.ndarray, start: str) -> list[Hypothesis]:
    """The allowed pose next to the given one."""
    T = pair.motion.exact(T_target_source)
    return [Hypothesis(T, start, pair.overlap_score(T))]


def from_solver(pair: Pair, T_target_source: np.ndarray, start: str, iterations: int | None = None) -> list[Hypothesis]:
    """Where the paper's IC solver goes from the allowed pose next to the given one; ``iterations`` of the options'."""
    g = pair.enter_box(pair.motion.exact(T_target_source))[None]
    iterations, robust = iterations or pair.options.iterations, pair.options.robust
    found = pair.solver.solve(pair.template, pair.sampled[0], g, iterations, robust, pair.motion.basis())
    T = pair.leave_box(found.g[0])
    return [Hypothesis(T, start, pair.overlap_score(T), found.errors[:, 0].tolist())]


def rivals(pair: Pair, T_target_source: np.ndarray) -> tuple[list[Hypothesis], float]:
    """Poses that fit as well as this one might, where the scene repeats itself: the nearest ones of its orbit.

    And how much of the scene repeats: the share of the matches behind the pose that agree on another one.

    The matches behind the pose have runners-up: other places that look alike. What pose these agree on, T', differs
    from T by a motion S = T' T^-1 that maps the target (or, S' = T^-1 T', the source) onto itself: a period of a
    facade, a turn of a gear. Where there is one there are its powers, S S T and S^-1 T, and its products with others.
    What has too few features to say so may still be symmetric about an axis of its own: half-turns are tried as well.
    """
    behind = max(pair.inlier_count(T_target_source), 1)
    back = np.linalg.inv(T_target_source)
    score = pair.overlap_score(T_target_source)
    turns = [*half_turns(pair.t.points), *(T_target_source @ S @ back for S in half_turns(pair.s.points))]
    least = HALF_TURNED * score
    generators = [S for S in turns if pair.overlap_score(S @ T_target_source, least) >= least]
    x, y = runners_up(pair, T_target_source)
    repeats = 0.0
    if len(x) >= RIVAL_MATCHES:
        poses, counts = agreed(pair, x, y)
        least = max(RIVAL_MATCHES, RIVAL_SHARE * behind)
        steps = [T @ back for T, count in zip(poses, counts, strict=True) if count >= least]
        generators += [*steps, *(np.linalg.inv(S) for S in steps)]
        repeats = min(float(counts.max(initial=0)) / behind, 1.0)
    return orbit(pair, T_target_source, generators, RIVAL_SCORE * score), repeats


def orbit(pair: Pair, T_target_source: np.ndarray, generators: list[np.ndarray], floor: float) -> list[Hypothesis]:
    """The poses S T, S S' T, ... of motions S (4, 4) of the target that score at least ``floor``, the nearest first."""
    found: list[Hypothesis] = []
    tried = [T_target_source]
    queue = [S @ T_target_source for S in generators]
    while queue and len(tried) <= ORBIT and len(found) < RIVALS:
        T = queue.pop(0)
        if pair.among(T, np.array(tried)):
            continue
        tried.append(T)
        score = pair.overlap_score(T, floor)
        if score >= floor and pair.allowed(T):
            found.append(Hypothesis(T, "rival", score))
            queue += [S @ T for S in generators]
    return found


def half_turns(points: np.ndarray) -> list[np.ndarray]:
    """The half-turns (4, 4) about a cloud's principal axes, of which a symmetric thing has some: a table, a box."""
    middle = points.mean(0)
    found = []
    for axis in np.linalg.eigh((points - middle).T @ (points - middle))[1].T:
        S = np.eye(4)
        S[:3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
        S[:3, 3] = middle - S[:3, :3] @ middle
        found.append(S)
    return found


def runners_up(pair: Pair, T_target_source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints that look like the ones behind a pose and lie elsewhere: source and target, (C, 3) each."""
    p, q = pair.described(pair.source)[0], pair.described(pair.target)[0]
    moved = transform_points(T_target_source, p)
    apart = distances_between(moved, q)
    similarity = pair.similarity
    behind = similarity.argmax(1), similarity.argmax(0)
    tolerance = CONSENSUS_TOLERANCE * pair.edge
    rows = np.flatnonzero(apart[np.arange(len(p)), behind[0]] < tolerance)
    columns = np.flatnonzero(apart[behind[1], np.arange(len(q))] < tolerance)
    similarity = np.where(apart < ELSEWHERE * pair.edge, -1.0, similarity)
    forth, back = most_alike(similarity[rows]), most_alike(similarity[:, columns].T)
    i = np.concatenate([np.repeat(rows, forth.shape[1]), back.ravel()])
    j = np.concatenate([forth.ravel(), np.repeat(columns, back.shape[1])])
    return p[i], q[j]


def most_alike(similarity: np.ndarray) -> np.ndarray:
    """The columns of the RUNNERS_UP greatest of each row, greatest first."""
    count = min(RUNNERS_UP, similarity.shape[1])
    some = np.sort(np.argpartition(-similarity, count - 1, axis=1)[:, :count], axis=1)
    return np.take_along_axis(some, np.argsort(-np.take_along_axis(similarity, some, 1), axis=1, kind="stable"), 1)


def distances_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a_i - b_j| of points (A, 3) and (B, 3): (A, B)."""
    return np.sqrt(np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * a @ b.T, 0))
