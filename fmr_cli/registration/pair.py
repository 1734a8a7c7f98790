"""Two prepared clouds on one voxel grid: what is known of the pair before any pose, and what a pose is worth.

Poses here are (4, 4) between the two centred frames: ``T_target_source`` moves the centred source onto the centred
target. ``enter_box`` and ``leave_box`` take them to the encoder's unit box and back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.descriptors.matching import match
from fmr_cli.errors import RegistrationError
from fmr_cli.feature_metric.inverse_compositional import Template
from fmr_cli.feature_metric.numpy_encoder import spread
from fmr_cli.geometry.frames import Frame, enter_frames, leave_frames
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.pose_error import angle_between
from fmr_cli.geometry.sampling import sample
from fmr_cli.registration.models import fast_encoder, local_encoder, solver
from fmr_cli.registration.options import Options
from fmr_cli.registration.prepared import MIN_POINTS, Prepared, pair_edge
from fmr_cli.registration.units import unit_hint

KEYPOINTS = 500  # of a cloud
CONSENSUS_TOLERANCE = 2.0  # voxel edges: how far a keypoint's place may lie off in two samplings of one surface
RANKING_POINTS = 800  # of the source, on which poses are compared
RANKED_FIRST = 4  # one in so many of these tells a score to 0.03: where it is half of what is asked for, it is below
DISTINCT_DEGREES, DISTINCT_EDGES = 10.0, 4.0  # poses nearer than both are one: a refinement moves them together


class Pair:
    """Two prepared clouds at one voxel edge, with the networks and the motions that the options ask for.

    edge: of the voxels, file's unit. keypoints: how many places of each cloud are described. threads: 2 where both
    clouds may be worked on side by side. Raises RegistrationError where a cloud has too few voxels.
    """

    def __init__(
        self, source: Prepared, target: Prepared, options: Options, edge: float, keypoints: int, threads: int = 1
    ) -> None:
        self.source, self.target, self.options, self.threads = source, target, options, threads
        self.edge, self.keypoints, self.seed = edge, keypoints, options.seed
        self.encoder, self.local = fast_encoder(options.model), local_encoder(options.model)
        self.solver = solver(options.model, options.device)
        up = np.asarray(options.up, float)
        up /= np.linalg.norm(up)
        lift = float(up @ (source.centre - target.centre))  # what "planar" keeps of the shift between centred frames
        self.motion = Motion(options.dof, (float(up[0]), float(up[1]), float(up[2])), lift)
        self.s, self.t = self.both(lambda cloud: cloud.surface(edge))
        self._scores: dict[bytes, float] = {}  # by pose
        for cloud, surface in ((source, self.s), (target, self.t)):
            if len(surface.points) < MIN_POINTS:
                what = f"fewer than {MIN_POINTS} voxels of {edge:.3g} hold points; lower --voxel-size"
                if options.voxel_size is None:
                    what = unit_hint(source.points, target.points) or (
                        f"is too small beside the other cloud: fewer than {MIN_POINTS} voxels of {edge:.3g} hold "
                        "points; are they in one unit?"
                    )
                raise RegistrationError(f"{cloud.name}: {what}")

    def both(self, work: Callable[..., Any], *each: Sequence[Any]) -> list[Any]:
        """What ``work`` gives of source and target, and of one of ``each``, side by side where two threads may."""
        with spread(self.threads) as run:
            return list(run(work, (self.source, self.target), *each))

    @property
    def flat_planes(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The normals of source and target where both are flat by nature, see ``geometry.planar``."""
        s, t = self.source.plane, self.target.plane
        return None if s is None or t is None else (s, t)

    # In the files' coordinates, and in the encoder's unit box.

    def enter_centred(self, T_target_source: np.ndarray) -> np.ndarray:
        """A pose between the files' coordinates as one between the centred frames."""
        return enter_frames(T_target_source, self.source.frame, self.target.frame)

    def leave_centred(self, T_target_source: np.ndarray) -> np.ndarray:
        """A pose between the centred frames as one between the files' coordinates."""
        return leave_frames(T_target_source, self.source.frame, self.target.frame)

    @cached_property
    def boxes(self) -> tuple[Frame, Frame]:
        """The encoder's frames of source and target: it was trained on clouds about their mean, of half extent 0.5."""
        if not self.options.normalize:  # the files' coordinates are taken to be so already
            return Frame(-self.source.centre), Frame(-self.target.centre)
        length = 2 * float(np.abs(self.t.points - self.t.points.mean(0)).max())
        return Frame(self.s.points.mean(0), length), Frame(self.t.points.mean(0), length)

    def enter_box(self, T_target_source: np.ndarray) -> np.ndarray:
        """A pose between the centred frames as one between the encoder's."""
        return enter_frames(T_target_source, *self.boxes)

    def leave_box(self, g: np.ndarray) -> np.ndarray:
        """A pose between the encoder's frames as one between the centred frames."""
        return leave_frames(g, *self.boxes)

    @cached_property
    def sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """What the global encoder sees: Q of the source and P of the target, (points, 3) float32, in their boxes."""
        rng = np.random.default_rng(self.seed)
        Q, P = (
            box.enter(sample(x.points, self.options.points, rng)).astype(np.float32)
            for box, x in zip(self.boxes, (self.s, self.t), strict=True)
        )
        return Q, P

    @cached_property
    def template(self) -> Template[np.ndarray]:
        """The global feature F(P) of the target, and its Jacobian."""
        return self.encoder.template(self.sampled[1], self.threads)

    @cached_property
    def target_feature(self) -> np.ndarray:
        """F(P) alone: its Jacobian, which the solver needs, costs half as much again."""
        return self.encoder(self.sampled[1], self.threads)

    def feature_error(self, T_target_source: np.ndarray) -> float:
        """Mean |F(g Q) - F(P)| of the global feature at a pose."""
        g = self.enter_box(T_target_source).astype(np.float32)
        moved = self.encoder(transform_points(g, self.sampled[0]), self.threads)
        return float(np.abs(moved - self.target_feature).mean())

    # What local features say.

    def describe(self) -> None:
        """Works out what concerns one cloud alone; both side by side where there are two threads for it."""
        self.both(self.described)

    def described(self, cloud: Prepared) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints of a cloud and their descriptors."""
        return cloud.described(self.edge, self.keypoints, self.local)

    @cached_property
    def matches(self) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints of source and target whose descriptors match: (C, 3) each, row by row."""
        (p, a), (q, b) = self.described(self.source), self.described(self.target)
        pairs = match(a, b)
        return p[pairs[:, 0]], q[pairs[:, 1]]

    def inlier_count(self, T_target_source: np.ndarray) -> int:
        """How many matches agree with a pose, whatever start it came from."""
        x, y = self.matches
        distance = np.linalg.norm(transform_points(T_target_source, x) - y, axis=1)
        return int((distance < CONSENSUS_TOLERANCE * self.edge).sum())

    @cached_property
    def similarity(self) -> np.ndarray:
        """Cosines between the descriptors of the source's and the target's keypoints: (K, L)."""
        return self.described(self.source)[1] @ self.described(self.target)[1].T

    # What surfaces say.

    @cached_property
    def some(self) -> tuple[np.ndarray, np.ndarray]:
        """A few of the source's points, and their normals: (n, 3) each."""
        both = np.hstack([self.s.points, self.s.normals])
        solid = both[self.s.solid] if self.s.solid.sum() >= MIN_POINTS else both
        both = sample(solid, RANKING_POINTS, np.random.default_rng(self.seed))
        return both[:, :3], both[:, 3:]

    def overlap_score(self, T_target_source: np.ndarray, floor: float = 0.0) -> float:
        """How much of the source comes close to the target at a pose, normals along, from 0 to 1, on few points.

        floor: what is below it may be told as 0; of what is plainly so, one point in RANKED_FIRST is asked.
        """
        key = T_target_source.tobytes()  # a pose is asked about when it is found, ranked, refined and found again
        if key not in self._scores:
            if floor and self._overlap_score(T_target_source, RANKED_FIRST) < floor / 2:
                return 0.0
            self._scores[key] = self._overlap_score(T_target_source)
        return self._scores[key]

    def _overlap_score(self, T_target_source: np.ndarray, every: int = 1) -> float:
        points, normals = (x[::every] for x in self.some)
        reach = 2 * self.edge
        d, i = self.t.tree.query(transform_points(T_target_source, points), distance_upper_bound=reach)
        here = np.flatnonzero(np.isfinite(d))
        cosine = np.einsum("ni,ni->n", normals[here] @ T_target_source[:3, :3].T, self.t.normals[i[here]])
        return float(((1 - d[here] / reach) * cosine**4).sum() / len(points))

    def same(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Whether two poses are one, but for what a refinement moves."""
        return self.among(a, b[None])

    def among(self, T: np.ndarray, others: np.ndarray) -> bool:
        """Whether a pose (4, 4) is the ``same`` as one of others (n, 4, 4)."""
        return is_among(T, others, self.edge)

    def allowed(self, T_target_source: np.ndarray) -> bool:
        """Whether a pose keeps to the options' ``max_angle`` and ``max_shift``."""
        shift = np.linalg.norm(T_target_source[:3, 3] + self.target.centre - self.source.centre)
        max_angle, max_shift = self.options.max_angle, self.options.max_shift
        return (max_angle is None or angle_degrees(T_target_source) <= max_angle) and (
            max_shift is None or bool(shift <= max_shift)
        )


def is_among(T: np.ndarray, others: np.ndarray, edge: float) -> bool:
    """Whether a pose (4, 4) of a centred cloud is one of others (n, 4, 4), but for what a refinement moves.

    edge: of the voxels that it is registered on.
    """
    off = others[:, :3, 3] - T[:3, 3]
    near = (off * off).sum(1) < (DISTINCT_EDGES * edge) ** 2
    turned = angle_between(T[:3, :3], others[near, :3, :3]) if near.any() else np.empty(0)
    return bool((turned < np.radians(DISTINCT_DEGREES)).any())


def make_pair(
    source: Prepared,
    target: Prepared,
    options: Options,
    threads: int = 1,
    coarseness: float = 1.0,
    keypoints: int = KEYPOINTS,
) -> Pair:
    """The two clouds at ``coarseness`` times the voxel edge that the options say, or else that suits both."""
    edge = (options.voxel_size or pair_edge(source, target)) * coarseness
    return Pair(source, target, options, edge, keypoints, threads)
