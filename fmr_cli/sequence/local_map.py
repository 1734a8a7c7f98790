"""The last keyframes as one map, and how well a scan fits it. Lengths are in voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import small_gicp

from fmr_cli.cloud import transform_points
from fmr_cli.sequence.known_map import KnownMap
from fmr_cli.sequence.observability import (
    STANDING,
    WRONG,
    WRONG_STANDING,
    Matches,
    Observability,
    clearly_observed,
    observe,
)
from fmr_cli.sequence.plane_map import PlaneMap, VoxelSums
from fmr_cli.sequence.prepared_scan import MIN_POINTS, NEIGHBOURS, PreparedScan, with_covariances

# Edges of the map's three levels, voxels: the working one, and two from which larger motions are reached.
FINE, COARSE, WIDE = 1.0, 2.0, 8.0
REACH = 3.0  # edges of the level within which a point's counterpart is sought
MAX_ITERATIONS = 30  # of small_gicp at one level; it rarely takes half of them
ROTATION_EPSILON, TRANSLATION_EPSILON = 1e-4, 1e-2  # radians, voxels, at an edge of 1: a step that moves less ends it
# Keyframes that the map is rebuilt from once it holds twice as many. Set by hand: it bounds the memory, and holds what
# is within sight of any sensor at KEYFRAME_MOTION apart (see ``odometry``).
MAP_KEYFRAMES = 20
# What a point without counterpart costs where two poses are compared, in the unit of ``Fit.cost``. Set by hand: more
# than a counterpart costs at the end of the reach that still fits.
OUTLIER_COST = 4.0
SOME = 500  # points of a scan, about, that say how far it has moved
# Of how far the neighbours stray from a plane (``PreparedScan.tilt``), what a normal may be wrong by: ten neighbours
# that stray each for itself leave 1 / sqrt(10 - 3) of it, a little more is allowed for what they share.
TILTED = 0.5
NO_LRU = 1 << 30  # insertions after which small_gicp would forget a voxel: never


@dataclass(frozen=True)
class Fit:
    """A scan's pose against the map, T_map_scan (4, 4), and what it comes to.

    overlap: the share of the scan's points that have a counterpart on the map. cost: their mean squared distance over
    the local variance, halved. start: the initial guess it came from. rms: distance of those points from the map's
    planes, voxels, NaN before ``LocalMap.polish``; seen: which directions are observed, None before it, and where too
    few points lie on planes to tell. verified: the registration onto the scan before has shown that it is right.
    doubtful: it has leapt to here by local features, and that registration would not vouch for it.
    """

    T_map_scan: np.ndarray
    overlap: float
    cost: float
    start: str
    rms: float = float("nan")
    seen: Observability | None = None
    verified: bool = False
    doubtful: bool = False

    @property
    def total(self) -> float:
        """Cost a point, those without counterpart included: the smaller, the better the pose."""
        return self.overlap * self.cost + (1 - self.overlap) * OUTLIER_COST


@dataclass(frozen=True)
class Keyframe:
    """A scan that is part of the map: its place in the sequence, and its pose (4, 4)."""

    index: int
    T_map_scan: np.ndarray


class Surface:
    """What scans have seen, as Gaussian voxel maps of three edges and as planes; a known map below, if there is one."""

    def __init__(self, known: KnownMap | None = None) -> None:
        self.levels = {edge: small_gicp.GaussianVoxelMap(edge) for edge in (FINE, COARSE, WIDE)}
        for level in self.levels.values():
            level.set_lru(horizon=NO_LRU)
        self.planes = PlaneMap(two_sided=known is not None)
        if known:
            self.add(known.cloud, known.cloud, VoxelSums.of(known.points, known.normals, np.eye(4)), np.eye(4))

    def add(
        self, fine: small_gicp.PointCloud, coarse: small_gicp.PointCloud, seen: VoxelSums, T_map_scan: np.ndarray
    ) -> None:
        """Add a scan: its points with covariances, fewer of them for large voxels, and what they come to by voxel."""
        for edge, level in self.levels.items():
            level.insert(fine if edge == FINE else coarse, T_map_scan)
        self.planes.add(seen)


class LocalMap:
    """The last keyframes as one surface; a known map below them, if there is one.

    It is a function of these alone: so it can be built again after a kill. Keyframes add to a known map only where it
    has nothing. Those that will be left once the oldest are forgotten make up a second surface meanwhile: so no scan
    has to be kept.
    """

    def __init__(self, known: KnownMap | None = None) -> None:
        self.known = known
        self.keyframes: list[Keyframe] = []
        self.surface = Surface(known)
        self.later: Surface | None = None

    def insert(self, index: int, scan: PreparedScan, T_map_scan: np.ndarray) -> None:
        """Add a keyframe; where there are many, the oldest are forgotten."""
        self.keyframes.append(Keyframe(index, T_map_scan))
        self._add(scan, T_map_scan)
        if len(self.keyframes) == 2 * MAP_KEYFRAMES:
            self.keyframes = self.keyframes[-MAP_KEYFRAMES:]
            self.surface, self.later = self.later or Surface(self.known), None

    def _add(self, scan: PreparedScan, T_map_scan: np.ndarray) -> None:
        points, normals = scan.points[scan.solid], scan.normals[scan.solid]
        fine, coarse = scan.cloud, scan.fitted  # large voxels get points enough of the few, too
        if self.known:
            new = self.known.beyond(transform_points(T_map_scan, points))
            if new.sum() < MIN_POINTS:
                return
            points, normals = points[new], normals[new]
            fine = coarse = with_covariances(points, NEIGHBOURS)
        seen = VoxelSums.of(points, normals, T_map_scan)
        self.surface.add(fine, coarse, seen, T_map_scan)
        if len(self.keyframes) > MAP_KEYFRAMES:
            self.later = self.later or Surface(self.known)
            self.later.add(fine, coarse, seen, T_map_scan)

    def fit(
        self, scan: PreparedScan, T_map_guess: np.ndarray, edges: tuple[float, ...], start: str, few: bool = False
    ) -> Fit:
        """The scan's pose near a guess, by distribution-to-distribution ICP on the levels ``edges``, one after another.

        start: what the guess is called. few: by few of the scan's points.
        """
        T_map_scan, cloud = T_map_guess, scan.fitted if few else scan.cloud
        for edge in edges:
            found = small_gicp.align(
                self.surface.levels[edge], cloud, T_map_scan, max_correspondence_distance=REACH * edge, num_threads=1,
                max_iterations=MAX_ITERATIONS, rotation_epsilon=ROTATION_EPSILON * edge,
                translation_epsilon=TRANSLATION_EPSILON * edge,
            )  # fmt: skip
            T_map_scan = found.T_target_source
        inliers = max(found.num_inliers, 1)
        return Fit(T_map_scan, found.num_inliers / cloud.size(), found.error / inliers, start)

    def polish(self, scan: PreparedScan, fit: Fit, slope: float) -> tuple[Fit, float]:
        """The fit with the pose that robust weights give, what is observed there, and this scan's slope.

        slope: how residuals grow with range, see ``plane_map.trust``.
        """
        T_map_scan, rms, slope, matches = self.surface.planes.fit(scan, fit.T_map_scan, slope)
        seen = self._seen(scan, T_map_scan, matches) if matches else None
        return replace(fit, T_map_scan=orthonormal(T_map_scan), rms=rms, seen=seen), slope

    def _seen(self, scan: PreparedScan, T_map_scan: np.ndarray, matches: Matches) -> Observability:
        wrong = WRONG_STANDING if self.moved(scan, T_map_scan) < STANDING else WRONG
        clear = clearly_observed(matches, wrong)
        if clear:
            return clear
        which = matches.index
        seen = observe(matches, scan.trust()[which], wrong)
        if seen.observed.all():
            return seen
        # Beside flawless walls an edge is no worse than elsewhere, and normals no more wrong than their neighbours say.
        hint = observe(matches, scan.trust(WRONG)[which], np.minimum(wrong, TILTED * scan.tilt[which]))
        return replace(seen, hint=float(hint.reliability.min()))

    def moved(self, scan: PreparedScan, T_map_scan: np.ndarray) -> float:
        """Voxels, on average, from where the nearest of the keyframes stood."""
        return min((displacement(T_map_scan, k.T_map_scan, scan.points) for k in self.keyframes), default=np.inf)


def displacement(T_map_a: np.ndarray, T_map_b: np.ndarray, points: np.ndarray) -> float:
    """How far apart two poses put points (N, 3), on average over SOME: rotation and shift in one figure."""
    apart = T_map_a - T_map_b
    some = points[:: max(len(points) // SOME, 1)]
    return float(np.linalg.norm(some @ apart[:3, :3].T + apart[:3, 3], axis=1).mean())


def orthonormal(T_a_b: np.ndarray) -> np.ndarray:
    """T_a_b with its rotation made exact, so that rounding does not grow from frame to frame."""
    U, _, Vt = np.linalg.svd(T_a_b[:3, :3])
    T_a_b = T_a_b.copy()
    T_a_b[:3, :3] = U @ Vt
    return T_a_b
