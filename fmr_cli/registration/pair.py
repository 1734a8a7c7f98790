"""The steps of one registration: two prepared clouds, where a pose may start, how it is refined and judged.

Poses here are 4x4 between the clouds' local frames (each about its own mean); ``registration.align`` puts the steps in
order and translates to the files' coordinates.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import angle_degrees
from fmr_cli.descriptors.consensus import consensus
from fmr_cli.descriptors.matching import match
from fmr_cli.descriptors.patch_encoder import LocalEncoder
from fmr_cli.errors import RegistrationError
from fmr_cli.feature_metric.fast import FastEncoder, Template
from fmr_cli.feature_metric.patches import Neighbourhoods, patch_template, refine
from fmr_cli.feature_metric.search import STARTS, Solver, search
from fmr_cli.geometry import gicp, point_to_plane
from fmr_cli.geometry.motion import Motion, rotations
from fmr_cli.geometry.sampling import sample
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration import confidence
from fmr_cli.registration.prepared import MIN_POINTS, SPACINGS, Prepared

KEYPOINTS = 500
CONSENSUS_TOLERANCE = 2.0  # voxel edges
CONSENSUS_POSES = 5
RANKING_POINTS = 800
LEVELS = ((12.0, 2.0), (6.0, 1.0))  # patch radius and grid, in voxel edges, coarse to fine; the polish does the rest
FINE = LEVELS[1:]
DISTINCT_DEGREES, DISTINCT_EDGES = 10.0, 4.0  # poses nearer than both are one
CHANCE_POSES = 8
PATCHES, PATCH_ITERATIONS, BALL_POINTS = 96, 5, 128
POLISH_TARGET, POLISH_SOURCE = 24_000, 8_000
EXACT_TARGET = 200_000  # points of the target that the winner is polished against once more, each its own
FINER = 4.0  # times the grid of the last polish of large clouds, where they are dense enough
COMMON = 0.25  # spacings, within which most points have their counterpart if the scans have points in common
POLISH_REACH = 6.0  # voxel edges: source points further from the target only slow its k-d tree down, by up to 500 times


@dataclass
class Candidate:
    """A pose with what speaks for it. start: where it came from; errors: mean |r| of the IC solver that led to it.

    confidence: that it is right, given the other candidates; set once these are known.
    """

    T: np.ndarray
    start: str
    errors: list[float]
    evidence: confidence.Evidence
    confidence: float = 0.0

    @cached_property
    def odds(self) -> float:
        return confidence.odds(self.evidence)


@dataclass
class Start:
    """A pose to refine. errors: mean |F(g Q) - F(P)| of each iteration where the IC solver led to it, else empty."""

    T: np.ndarray
    name: str
    errors: list[float]


class Pair:
    """Two clouds at one voxel edge. encoder: F; solver: from given starts; local: encodes patches; motion: allowed."""

    def __init__(
        self,
        source: Prepared,
        target: Prepared,
        encoder: FastEncoder,
        solver: Solver,
        local: LocalEncoder,
        motion: Motion,
        *,
        edge: float,
        keypoints: int,
        normalize: bool,
        points: int,
        iterations: int,
        robust: bool,
        seed: int,
        threads: int = 1,
    ) -> None:
        self.threads = threads
        self.source, self.target, self.motion = source, target, motion
        self.encoder, self.solver, self.local = encoder, solver, local
        self.iterations, self.robust, self.seed = iterations, robust, seed
        self.edge, self.keypoints = edge, keypoints
        self.s, self.t = source.surface(self.edge), target.surface(self.edge)
        if min(len(self.s.points), len(self.t.points)) < MIN_POINTS:
            small = source if len(self.s.points) < MIN_POINTS else target
            raise RegistrationError(
                f"{small.name}: fewer than {MIN_POINTS} voxels of {self.edge:.3g} hold points; lower --voxel-size"
            )
        # The encoder was trained on clouds about their mean, of half extent 0.5.
        self.length = 2 * float(np.abs(self.t.points - self.t.points.mean(0)).max()) if normalize else 1.0
        self.origins = (self.s.points.mean(0), self.t.points.mean(0)) if normalize else (-source.centre, -target.centre)
        rng = np.random.default_rng(seed)
        self.Q, self.P = (
            ((sample(x.points, points, rng) - c) / self.length).astype(np.float32)
            for x, c in zip((self.s, self.t), self.origins, strict=True)
        )

    @cached_property
    def template(self) -> Template:
        """The global feature of the target, and its Jacobian."""
        return self.encoder.template(self.P, self.threads)

    # Between the local frames and the encoder's: x -> (x - origin) / length.

    def normalised(self, T: np.ndarray) -> np.ndarray:
        g = T.copy()
        g[:3, 3] = (T[:3, :3] @ self.origins[0] + T[:3, 3] - self.origins[1]) / self.length
        return g

    def restored(self, g: np.ndarray) -> np.ndarray:
        T = g.copy()
        T[:3, 3] = self.length * g[:3, 3] + self.origins[1] - g[:3, :3] @ self.origins[0]
        return T

    # Where a pose may start.

    def describe(self) -> None:
        """Works out what concerns one cloud alone; both side by side where there are two threads for it."""
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(self.described, (self.source, self.target)))

    def described(self, cloud: Prepared) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints of a cloud and their descriptors."""
        return cloud.described(self.edge, self.keypoints, self.local)

    @cached_property
    def matches(self) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints of source and target whose descriptors match: (C, 3) each, row by row."""
        (p, a), (q, b) = self.described(self.source), self.described(self.target)
        pairs = match(a, b)
        return p[pairs[:, 0]], q[pairs[:, 1]]

    def votes(self, T: np.ndarray) -> int:
        """How many matches agree with a pose, whatever start it came from."""
        x, y = self.matches
        distance = np.linalg.norm(x @ T[:3, :3].T + T[:3, 3] - y, axis=1)
        return int((distance < CONSENSUS_TOLERANCE * self.edge).sum())

    @cached_property
    def agreed(self) -> list[tuple[np.ndarray, float]]:
        """Poses that matches agree on, best first, each with its coincidence."""
        x, y = (k / self.edge for k in self.matches)
        motion = Motion(self.motion.dof, self.motion.up, self.motion.lift / self.edge)
        T = consensus(x, y, CONSENSUS_TOLERANCE, CONSENSUS_POSES, motion)[0]
        T[:, :3, 3] *= self.edge
        return [(pose, self.coincidence(pose)) for pose in T]

    def from_features(self) -> list[Start]:
        """Matched local features and their spatial consensus: any rotation, part overlap."""
        return [Start(T, "features", []) for T, _ in self.agreed]

    def from_search(self) -> list[Start]:
        """The global feature from rotations spread over all that are allowed: any rotation, full overlap."""
        starts = self.motion.starts(STARTS)
        if self.motion.dof == "planar":
            up = np.array(self.motion.up)
            offset = up @ (self.origins[0] - self.origins[1])
            starts[:, :3, 3] = (self.motion.lift + offset) / self.length * up
        found = search(self.solver, self.Q, self.P, starts, self.robust, self.motion.basis(), self.threads)
        return [Start(self.restored(g), "search", e.tolist()) for g, e in zip(found.g, found.errors.T, strict=True)]

    def from_pose(self, T: np.ndarray, name: str) -> list[Start]:
        """The allowed pose next to T."""
        return [Start(self.motion.exact(T), name, [])]

    def from_solver(self, T: np.ndarray, name: str) -> list[Start]:
        """Where the IC solver of the paper goes from the allowed pose next to T."""
        g = self.normalised(self.from_pose(T, name)[0].T)[None]
        found = self.solver.solve(self.template, self.Q, g, self.iterations, self.robust, self.motion.basis())
        return [Start(self.restored(found.g[0]), name, found.errors[:, 0].tolist())]

    # How a pose is refined and judged.

    @cached_property
    def some(self) -> tuple[np.ndarray, np.ndarray]:
        """A few of the source's points, and their normals."""
        both = sample(np.hstack([self.s.points, self.s.normals]), RANKING_POINTS, np.random.default_rng(self.seed))
        return both[:, :3], both[:, 3:]

    def coincidence(self, T: np.ndarray) -> float:
        """How much of the source comes close to the target at T, normals along, from 0 to 1, on few points."""
        points, normals = self.some
        reach = 2 * self.edge
        d, i = self.t.tree.query(points @ T[:3, :3].T + T[:3, 3], distance_upper_bound=reach)
        here = np.isfinite(d)
        cosine = np.einsum("ni,ni->n", normals[here] @ T[:3, :3].T, self.t.normals[i[here]])
        return float(((1 - d[here] / reach) * cosine**4).sum() / len(points))

    def refine(self, T: np.ndarray, levels: tuple[tuple[float, float], ...]) -> np.ndarray:
        """The pose after the feature metric of local patches, from coarse to fine."""
        g = T.copy()
        g[:3, 3] /= self.length
        for radius, coarseness in levels:
            s, t = (x.surface(self.edge * coarseness) for x in (self.source, self.target))
            reach = radius * self.edge
            centres = self.patch_centres(s, t, g, reach) / self.length
            look_s, look_t = balls(s, reach, self.length), balls(t, reach, self.length)
            template = patch_template(self.encoder.layers, centres, look_t, reach / self.length)
            g = refine(self.encoder.layers, template, look_s, g, PATCH_ITERATIONS, self.motion.basis()).g
        g[:3, 3] *= self.length
        return g

    def patch_centres(self, s: Surface, t: Surface, g: np.ndarray, reach: float) -> np.ndarray:
        """Points of the target, spread evenly, that the source comes near to at g: (P, 3)."""
        some = sample(t.points, 6 * PATCHES, np.random.default_rng(self.seed))
        back = (some - g[:3, 3] * self.length) @ g[:3, :3]
        common = some[np.isfinite(s.tree.query(back, distance_upper_bound=reach / 2)[0])]
        return (common if len(common) >= 8 else some)[:PATCHES]

    def judged(self, T: np.ndarray, start: Start) -> Candidate:
        """A pose with the evidence gathered at it."""
        rivals = [coincidence for pose, coincidence in self.agreed + self.chance if not self.same(T, pose)]
        return Candidate(
            T,
            start.name,
            start.errors,
            confidence.Evidence(
                **confidence.fit(self.s, self.t, T),
                votes=self.votes(T),
                fit_over_rival=self.coincidence(T) / max(*rivals, 1e-3),
            ),
        )

    def same(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Whether two poses are one, but for what a refinement moves."""
        angle = angle_degrees(np.linalg.inv(a) @ b)
        return bool(angle < DISTINCT_DEGREES and np.linalg.norm(a[:3, 3] - b[:3, 3]) < DISTINCT_EDGES * self.edge)

    @cached_property
    def chance(self) -> list[tuple[np.ndarray, float]]:
        """Poses as good as random, rotations about the means, each with its coincidence."""
        poses = [self.restored(g) for g in rotations(CHANCE_POSES)]
        return [(pose, self.coincidence(pose)) for pose in poses]

    def candidate(self, start: Start, polished: bool, scale: bool) -> Candidate:
        """A start, refined patch by patch, polished where asked, and judged."""
        T = self.motion.exact(start.T)
        if start.name != "features":
            T = self.refine(T, LEVELS)
        elif not polished:  # the polish alone comes as far from within CONSENSUS_TOLERANCE
            T = self.refine(T, FINE)
        return self.judged(self.polished(T, scale) if polished else T, start)

    def polished(self, T: np.ndarray, scale: bool) -> np.ndarray:
        """The pose after the last geometric step."""
        if scale or self.motion.dof != "rigid":
            s, t = self.source.fine(POLISH_SOURCE, self.edge), self.target.fine(POLISH_TARGET, self.edge)
            return point_to_plane.constrained(s, t, T, self.edge, self.motion.basis(), scale)
        target = self.target.for_gicp(POLISH_TARGET, self.edge, self.threads)
        return self.gicp(self.source.fine(POLISH_SOURCE, self.edge), target, T)

    def gicp(self, source: np.ndarray, target: gicp.GicpCloud, T: np.ndarray) -> np.ndarray:
        """GICP from T of those of the source's points that are in reach of the target."""
        moved = source @ T[:3, :3].T + T[:3, 3]
        near = source[np.isfinite(self.t.tree.query(moved, distance_upper_bound=POLISH_REACH * self.edge)[0])]
        if len(near) < MIN_POINTS:
            return T
        return gicp.gicp(gicp.GicpCloud(near, self.edge, self.threads), target, T, self.edge)

    def exact(self, T: np.ndarray) -> np.ndarray:
        """The pose after a polish on more than the one before saw, where there is more.

        Scans that have points in common come to coincide, point by point; otherwise a grid is the better mean, of
        large scans a finer one.
        """
        if self.motion.dof != "rigid" or len(self.target.points) <= POLISH_TARGET:
            return T
        if len(self.target.points) <= 4 * EXACT_TARGET and self.in_common(T):
            source = sample(self.source.points, POLISH_SOURCE, np.random.default_rng(self.seed))
            return self.gicp(source, self.target.for_gicp(EXACT_TARGET, self.edge, self.threads, own=True), T)
        fine = max(self.edge / FINER, SPACINGS * self.source.spacing, SPACINGS * self.target.spacing)
        if min(len(self.source.points), len(self.target.points)) < EXACT_TARGET or fine > self.edge / 2:
            return T
        s, t = (x.surface(fine).points for x in (self.source, self.target))
        some = sample(s, POLISH_SOURCE, np.random.default_rng(self.seed))
        source_cloud, target_cloud = (gicp.GicpCloud(x, fine, self.threads) for x in (some, t))
        return gicp.gicp(source_cloud, target_cloud, T, fine)

    def in_common(self, T: np.ndarray) -> bool:
        """Whether most of a few points of the source have their like in the target at T."""
        some = sample(self.source.points, RANKING_POINTS, np.random.default_rng(self.seed)) @ T[:3, :3].T + T[:3, 3]
        tree = cKDTree(self.target.points, balanced_tree=False, compact_nodes=False)
        distance = tree.query(some, distance_upper_bound=self.edge)[0]
        return bool(np.median(distance) <= COMMON * self.target.spacing)

    def feature_error(self, T: np.ndarray) -> float:
        """Mean |F(T Q) - F(P)| of the global feature at a pose."""
        g = self.normalised(T).astype(np.float32)
        return float(np.abs(self.encoder(self.Q @ g[:3, :3].T + g[:3, 3], self.threads) - self.template.feature).mean())


def balls(surface: Surface, radius: float, length: float) -> Neighbourhoods:
    """Look-ups for ``feature_metric.patches``: centres in units of ``length``, balls of ``radius`` (own unit)."""

    def look(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return surface.around(centres * length, radius, BALL_POINTS)[:2]

    return look
