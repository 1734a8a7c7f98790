"""A scan made ready for the odometry, and the working voxel that fits a sequence. Lengths are in voxels."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import small_gicp

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.normals import principal_variances, smallest_eigenvector
from fmr_cli.geometry.se3 import exp
from fmr_cli.geometry.voxels import voxel_downsample, voxel_means, voxel_ranks
from fmr_cli.sequence.deskew import deskew
from fmr_cli.sequence.voxel_frame import VoxelFrame

if TYPE_CHECKING:
    from fmr_cli.feature_metric.numpy_solver import NumpySolver
    from fmr_cli.registration.prepared import Prepared

# Points that a scan is thinned to. Set by hand on the LiDAR and depth-camera drives of the tests: more costs time and
# gains nothing measurable.
WORKING_POINTS = 12_000
# Of them, those that a pose is sought and judged by where it is well predicted, before all of them settle it. On the
# drives of the tests 2,000 give paths as good as 12,000 do; where all is settled by fewer, steps are worse.
FITTED_POINTS = 2_000
POINTS_PER_VOXEL = 2  # of a scan that has few points, on average: finer voxels would hold noise
# Edges, of the median distance to the tenth neighbour (a point itself among them): on a surface that fills its voxels
# they lie within 1.7; beyond 2.2, where a scanner's rings lie far apart, most voxels between them are empty.
HELD = 2.2
NOISE = 0.06  # edges, of the scatter about planes: normals of ten points in finer voxels are mostly noise
COARSER = 2.5  # times the edge that the count gives, at most: what still strays is curved, or clutter
GRAIN_EVERY = 3  # points, of which one is asked about its neighbours
NEIGHBOURS = 10  # points for a point's normal and covariance, small_gicp's own choice ...
MANY_NEIGHBOURS = 30  # ... and where a scanner's rings lie so far apart that these are mostly points of one ring
# A neighbourhood is a line where its second principal variance is less than so much of the first: any normal across it
# would do, and the one that noise picks is the scanner's pattern, which holds the scan where the map's keyframe stood.
LINE = 0.1
SPARSE = 0.15  # share of a scan's points whose neighbours are a line, from which more neighbours are asked
TILT = 3.0  # times the scan's median error, at which a normal is half trusted
# Voxels from the origin, 700 km for a scanner in a street: what lies beyond is no measurement, and two million voxels
# are as many as ``voxel_keys`` tells apart.
FARTHEST = 1 << 20
FEW = 128  # points that a scan's global feature is made of: enough to tell poses apart, under 1 ms
MIN_POINTS = 50  # of a thinned scan, below which registration is not worth a try; set by hand
# Times the edge that the density asks for, or divided by it: so far a wish is followed, set by hand. Finer voxels hold
# no surface, and on coarser ones a scan slides.
HINT = 1.25
STEPS = 6  # of the search for the voxel, at most; each brings the count within a few percent
COUNT_TOLERANCE = 0.1  # share by which the count may miss WORKING_POINTS
# The count goes with the edge to the power of -1.5 to -2 (the rings of a LiDAR, a surface): -1 / 0.6 lies in between.
EDGE_PER_COUNT = 0.6


class PreparedScan:
    """A scan in voxels: thinned ``points`` (N, 3), unit ``normals`` towards the sensor, ``ranges`` (N,) from it.

    ``solid`` (N,), False where the neighbours are a line, so that the normal means nothing; ``tilt`` (N,), rad, how far
    they stray from their plane, seen from where they lie along it. ``whole``: (M, 3) float32, the points before
    thinning. It can be pickled until one of its clouds was asked for. ``when``: (N,), when the points
    were measured, 0 to 1 over the scan, or None.
    """

    def __init__(self, points: np.ndarray, sensor: np.ndarray, times: np.ndarray | None = None) -> None:
        """points: (M, 3) before thinning; sensor: (3,); both in voxels. times: (M,), 0 to 1 over the scan."""
        self.whole = points.astype(np.float32)
        rank = voxel_ranks(points, 1.0)
        self.points = voxel_means(points, rank)
        self.when = None if times is None else voxel_means(times[:, None], rank)[:, 0]
        tree = small_gicp.KdTree(self.points)
        six = scatter(self.points, neighbours(tree, self.points, NEIGHBOURS))
        self.normals = smallest_eigenvector(*six)[0]
        self.solid = ~lines(six)
        self.tilt = tilt(six)
        self._neighbours = NEIGHBOURS  # of the covariances of ``cloud``
        if len(self.points) > MANY_NEIGHBOURS and not self.solid.all():
            self._look_wider(tree)
        rays = self.points - sensor
        self.normals[np.einsum("ij,ij->i", self.normals, rays) > 0] *= -1
        self.ranges = np.linalg.norm(rays, axis=1)
        self._feature: np.ndarray | None = None

    def _look_wider(self, tree: small_gicp.KdTree) -> None:
        """Give points whose neighbours are a line the normal of more of them.

        Rings across a corridor's floor and ceiling are all that holds a scanner's height and tilt there.
        """
        if self.solid.mean() < 1 - SPARSE:  # then the covariances of all, too
            self._neighbours = MANY_NEIGHBOURS
        on_line = np.flatnonzero(~self.solid)
        wider = scatter(self.points, neighbours(tree, self.points[on_line], MANY_NEIGHBOURS))
        self.normals[on_line] = smallest_eigenvector(*wider)[0]
        self.solid[on_line] = ~lines(wider)

    def deskewed(self, twist: np.ndarray) -> PreparedScan:
        """The same once more motion (6,) within the scan is undone, scan axes: so little that thinning stays as it was.

        ``whole`` is left as it is.
        """
        assert self.when is not None
        still = object.__new__(PreparedScan)
        still.whole, still.when, still.solid, still.tilt = self.whole, self.when, self.solid, self.tilt
        still.ranges, still._neighbours, still._feature = self.ranges, self._neighbours, None
        turn = twist * [1, 1, 1, 0, 0, 0]
        still.points, still.normals = (
            deskew(x, self.when, exp(motion)) for x, motion in ((self.points, twist), (self.normals, turn))
        )
        return still

    @cached_property
    def cloud(self) -> small_gicp.PointCloud:
        """The points for small_gicp, with a covariance each."""
        return with_covariances(self.points, self._neighbours)

    @cached_property
    def fitted(self) -> small_gicp.PointCloud:
        """FITTED_POINTS of them at most, evenly taken, likewise."""
        every = -(-len(self.points) // FITTED_POINTS)
        return with_covariances(self.points[::every], NEIGHBOURS) if every > 1 else self.cloud

    def __len__(self) -> int:
        return len(self.points)

    def trust(self, at_least: float = 0.0) -> np.ndarray:
        """(N,), 0 to 1: how far a normal can be trusted, beside the median of the same scan, or a tilt ``at_least``.

        At an edge, or where the neighbours are one ring of a spinning scanner, they fit no plane, and the normal there
        is the scanner's pattern, the same in every scan.
        """
        return 1 / (1 + (self.tilt / (TILT * max(np.median(self.tilt), at_least))) ** 4)

    @cached_property
    def few(self) -> np.ndarray:
        """(M, 3): FEW of the points, or all where there are fewer; even in their order, so alike in every scan."""
        count = len(self.points)
        return self.points[np.arange(min(FEW, count)) * count // min(FEW, count)]

    @cached_property
    def box(self) -> tuple[np.ndarray, float]:
        """Centre (3,) of the few points, and the radius about it that holds them all, voxels."""
        centre = self.few.mean(0)
        return centre, float(np.linalg.norm(self.few - centre, axis=1).max())

    def feature(self, encode: NumpySolver) -> np.ndarray:
        """(d,), the global feature of the few points in their box; worked out once, by the sequence's one encoder."""
        if self._feature is None:
            centre, unit = self.box
            self._feature = encode(((self.few - centre) / unit).astype(np.float32))
        return self._feature

    @cached_property
    def for_align(self) -> Prepared:
        """The scan as feature-metric registration takes it, which encodes it once."""
        from fmr_cli.registration.pipeline import prepare

        return prepare(PointCloud(self.points))

    def whole_for_align(self) -> Prepared:
        """The same with all of its points."""
        from fmr_cli.registration.pipeline import prepare

        return prepare(PointCloud(self.whole.astype(float)))


def with_covariances(points: np.ndarray, count: int) -> small_gicp.PointCloud:
    """Points (N, 3) for small_gicp, with the covariance of each one's nearest, so many of them."""
    cloud = small_gicp.PointCloud(points)
    small_gicp.estimate_covariances(cloud, num_neighbors=count)
    return cloud


def neighbours(tree: small_gicp.KdTree, points: np.ndarray, count: int) -> np.ndarray:
    """(N, count), int64: which points of the tree are nearest to points (N, 3)."""
    return tree.batch_knn_search(points, count)[0].astype(np.int64)


def scatter(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(6, N): xx, yy, zz, xy, xz, yz of the covariances of neighbourhoods near (N, k), indices of points (M, 3)."""
    x, y, z = (np.ascontiguousarray(column)[near.T] for column in points.T)
    for of_axis in (x, y, z):
        of_axis -= of_axis.mean(0)
    pairs = ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    return np.stack([np.einsum("ij,ij->j", a, b) for a, b in pairs]) / near.shape[1]


def lines(six: np.ndarray) -> np.ndarray:
    """(N,), whether neighbourhoods lie on a line, by the invariants of their covariances (``scatter``).

    The sum of the principal minors over the squared trace is r / (1 + r)² for principal variances 1, r, 0.
    """
    xx, yy, zz, xy, xz, yz = six
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return minors < LINE / (1 + LINE) ** 2 * (xx + yy + zz) ** 2


def tilt(six: np.ndarray) -> np.ndarray:
    """(N,), rad: how far neighbourhoods stray from their planes, seen from where they lie along them (``scatter``)."""
    least, middle, _ = principal_variances(*six)
    return np.sqrt(np.maximum(least, 0) / np.maximum(middle, 1e-12))


def prepare_scan(points: np.ndarray, frame: VoxelFrame, times: np.ndarray | None = None) -> PreparedScan | None:
    """Points (N, 3), file units, with their times (N,), 0 to 1, made ready; None where too few are left.

    Safe in another thread.
    """
    points = frame.points_to_voxels(points)
    if max(points.max(initial=0.0), -points.min(initial=0.0)) > FARTHEST:
        near = (np.abs(points) <= FARTHEST).all(1)
        points, times = points[near], None if times is None else times[near]
    if len(points) < MIN_POINTS:
        return None
    scan = PreparedScan(points, frame.sensor, times)
    return scan if len(scan) >= MIN_POINTS else None


def choose_voxel(points: np.ndarray, wish: float | None = None, others: Iterable[np.ndarray] = ()) -> float:
    """The voxel edge that suits a sequence whose first scan has points (N, 3), to two digits, in their unit.

    others: some of the later scans, (N, 3) each; the median of what suits each of them counts. wish: an edge to be near
    to, within HINT. Raises RegistrationError where the first scan's points are too few or all in one place.
    """
    edges = [suitable_voxel(points)]
    for other in others:
        with suppress(RegistrationError):
            edges.append(suitable_voxel(other))
    voxel = float(np.median(edges))
    return float(f"{voxel:.2g}" if wish is None else np.clip(wish, voxel / HINT, voxel * HINT))


def suitable_voxel(points: np.ndarray) -> float:
    """The finest edge for points (N, 3) whose voxels hold a surface (HELD) rather than noise (NOISE).

    It leaves WORKING_POINTS at most, and POINTS_PER_VOXEL in each on average. Raises RegistrationError.
    """
    wanted = min(WORKING_POINTS, len(points) // POINTS_PER_VOXEL)
    spread = np.linalg.norm(np.subtract(*np.percentile(points, [75, 25], axis=0)))
    if not spread > 0 or wanted < MIN_POINTS:
        raise RegistrationError("too few points, or all in one place")
    voxel, centred = float(spread) / 20, points - np.median(points, axis=0)
    for _ in range(STEPS):
        count = 1 + int(voxel_ranks(centred, voxel).max())
        if abs(count / wanted - 1) < COUNT_TOLERANCE:
            break
        voxel *= (count / wanted) ** EDGE_PER_COUNT
    largest = COARSER * voxel
    for _ in range(STEPS):
        apart, noise = grain(centred / voxel)
        if voxel >= largest or (apart <= HELD and noise <= NOISE):
            break
        voxel = min(voxel * max(apart / HELD, noise / NOISE), largest)
    return float(voxel)


def grain(points: np.ndarray) -> tuple[float, float]:
    """How far apart points (N, 3) in voxels are once thinned to one a voxel, and how noisy; in voxels.

    The median distance to the tenth neighbour; and how far the flattest quarter of the neighbourhoods strays from its
    planes (standard deviation), lines left out.
    """
    points = voxel_downsample(points, 1.0)
    if len(points) <= NEIGHBOURS:
        return 0.0, 0.0
    index, squared = small_gicp.KdTree(points).batch_knn_search(points[::GRAIN_EVERY], NEIGHBOURS)
    least, middle, most = principal_variances(*scatter(points, index.astype(np.int64)))
    flat = np.maximum(least[middle > LINE * most], 0)
    return float(np.sqrt(np.median(squared[:, -1]))), float(np.sqrt(np.quantile(flat, 0.25))) if len(flat) else 0.0
