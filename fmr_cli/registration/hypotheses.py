"""Where the pose of a pair may be: hypotheses from local features, from the search over rotations, from given poses.

Poses are between the centred frames of a ``Pair``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from fmr_cli.descriptors.consensus import consensus
from fmr_cli.feature_metric.search import STARTS, search
from fmr_cli.geometry.motion import Motion, rotations
from fmr_cli.registration.options import Matrix
from fmr_cli.registration.pair import CONSENSUS_TOLERANCE, Pair

CONSENSUS_POSES = 5  # poses that matches agree on, at most
CHANCE_POSES = 8  # poses as good as random, to compare with


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
    x, y = (keypoints / pair.edge for keypoints in pair.matches)
    motion = Motion(pair.motion.dof, pair.motion.up, pair.motion.lift / pair.edge)
    poses = consensus(x, y, CONSENSUS_TOLERANCE, CONSENSUS_POSES, motion)[0]
    poses[:, :3, 3] *= pair.edge
    return [Hypothesis(T, "features", pair.overlap_score(T)) for T in poses]


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


def from_solver(pair: Pair, T_target_source: np.ndarray, start: str) -> list[Hypothesis]:
    """Where the paper's IC solver goes from the allowed pose next to the given one."""
    g = pair.enter_box(pair.motion.exact(T_target_source))[None]
    iterations, robust = pair.options.iterations, pair.options.robust
    found = pair.solver.solve(pair.template, pair.sampled[0], g, iterations, robust, pair.motion.basis())
    T = pair.leave_box(found.g[0])
    return [Hypothesis(T, start, pair.overlap_score(T), found.errors[:, 0].tolist())]


def by_chance(pair: Pair) -> list[Hypothesis]:
    """Poses as good as random: rotations about the means."""
    poses = [pair.leave_box(g) for g in rotations(CHANCE_POSES)]
    return [Hypothesis(T, "chance", pair.overlap_score(T)) for T in poses]


def makers(
    pair: Pair, init: str | Matrix | np.ndarray, features: list[Hypothesis]
) -> Iterator[tuple[str, Callable[[], list[Hypothesis]]]]:
    """The kinds of start that ``Options.init`` asks for, in order: (stage, function). features: what that kind gave."""
    name = init if isinstance(init, str) else "given"
    if name in ("auto", "features"):
        yield "features", lambda: features
    if name in ("auto", "search"):
        yield "search", partial(from_search, pair)
    if name in ("given", "identity", "centroid"):  # as it is; where that does not fit, where the solver goes from it
        T = np.asarray(init, float) if name == "given" else np.eye(4)
        T = T if name == "centroid" else pair.enter_centred(T)  # the centred identity brings centroid onto centroid
        yield "start", partial(from_pose, pair, T, name)
        yield "solve", partial(from_solver, pair, T, name)
