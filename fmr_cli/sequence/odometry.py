"""Scan by scan into the frame of the first: predict, align to a local map, judge, and only then add to the map.

All lengths in here are in voxels: the clouds are shifted to the first scan's centre and divided by a voxel edge that
the first scan's own density gives. So every constant below holds for a Kinect as for a LiDAR, in metres as in
millimetres, and far from the origin. Everything runs in a fixed order on one thread, so that a run can be repeated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import small_gicp

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.sequence.plane_map import PlaneMap

WORKING_POINTS = 12_000  # what a scan is thinned to: more costs time and gains nothing measurable
POINTS_PER_VOXEL = 4  # but no finer than the scan itself allows
NEIGHBOURS = 10  # for a point's covariance
MIN_POINTS = 50  # of a thinned scan, below which it is not worth a try

FINE, COARSE, WIDE = 1.0, 2.0, 8.0  # edges of the map's three levels
REACH = 3.0  # correspondences are sought within so many voxels of a map
KEYFRAME_MOTION = 8.0  # mean displacement of the points since the last keyframe ...
KEYFRAME_RISE = 1.5  # ... or the fit so much worse than right after it: then the scan joins the map
MAP_KEYFRAMES = 20  # the map is rebuilt from so many once it holds twice as many

# A scan that fits has 0.7 to 0.95 of its points on the map at a mean cost of 0.3 to 0.7 (squared distance to the
# local planes over their variance, halved), whatever the sensor.
MIN_OVERLAP, MAX_COST = 0.35, 3.0
OVERLAP_DROP = 0.5  # against the running median
DOUBTFUL_OVERLAP, DOUBTFUL_TOTAL = 0.85, 1.25  # against the running medians: beyond, more starts are tried
OUTLIER_COST = 4.0  # what a point without counterpart costs where two poses are compared
CONVINCING = 2.3  # below such a total cost one start is enough; right poses have up to 2.1, wrong ones from 2.9
LOST_AFTER = 3  # so many uncertain frames in a row, and the map is begun anew at the prediction


FeatureErrors = tuple[float, float] | None


class Scan:
    """A scan made ready, in voxels: thinned ``points`` (N, 3), ``normals`` towards the sensor, ``ranges`` from it.

    ``cloud`` is the same for small_gicp, with a covariance per point.
    """

    def __init__(self, points: np.ndarray, sensor: np.ndarray) -> None:
        # Copied, because the thinned cloud has room for all points: some 20 MB for as long as the map keeps the scan.
        self.cloud = small_gicp.PointCloud(small_gicp.voxelgrid_sampling(points, 1.0).points())
        small_gicp.estimate_normals_covariances(self.cloud, num_neighbors=NEIGHBOURS)
        self.points = self.cloud.points()[:, :3]
        self.normals = self.cloud.normals()[:, :3]
        rays = self.points - sensor
        self.normals[np.einsum("ij,ij->i", self.normals, rays) > 0] *= -1
        self.ranges = np.linalg.norm(rays, axis=1)

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def prepared(self) -> Any:
        """For the feature-metric registration, which encodes a scan once."""
        from fmr_cli.registration.pipeline import prepare

        return prepare(PointCloud(self.points))


@dataclass(frozen=True)
class Fit:
    """A pose against the map: (4, 4) in voxels, the share of points on the map, their mean cost, their RMS distance."""

    T: np.ndarray
    overlap: float
    cost: float
    start: str
    rms: float = float("nan")

    @property
    def total(self) -> float:
        """Cost a point, those without counterpart included: the smaller, the better the pose."""
        return self.overlap * self.cost + (1 - self.overlap) * OUTLIER_COST


@dataclass(frozen=True)
class Frame:
    """What came of one scan.

    pose: (4, 4) float64, this frame to the first, file units. status: "aligned", or "uncertain": the pose is then the
    prediction, and the scan is kept out of the map. overlap: share of its points with a counterpart on the map.
    inlier_rmse: their root mean square distance from the map's local planes, file units. start: where the accepted
    pose came from ("first", "prediction", "still", "features"). feature_errors: before and after, where the
    feature-metric registration was asked.
    """

    pose: np.ndarray
    status: str
    overlap: float
    inlier_rmse: float
    start: str
    feature_errors: FeatureErrors = None


def choose_voxel(points: np.ndarray) -> float:
    """The voxel edge that thins points (N, 3) to WORKING_POINTS, or to a quarter of them where they are few.

    Raises RegistrationError where all points are in one place.
    """
    wanted = min(WORKING_POINTS, len(points) // POINTS_PER_VOXEL)
    spread = np.linalg.norm(np.subtract(*np.percentile(points, [75, 25], axis=0)))
    if not spread > 0 or wanted < MIN_POINTS:
        raise RegistrationError("too few points, or all in one place")
    voxel, centre = spread / 20, np.median(points, axis=0)
    for _ in range(6):
        count = small_gicp.voxelgrid_sampling((points - centre) / voxel, 1.0).size()
        if abs(count / wanted - 1) < 0.1:
            break
        voxel *= (count / wanted) ** 0.6  # between a surface (1/2) and a LiDAR's thinning rings (2/3)
    return float(f"{voxel:.2g}")


def displacement(A: np.ndarray, B: np.ndarray, points: np.ndarray) -> float:
    """How far apart two poses put points (N, 3), on average: rotation and shift in one figure."""
    return float(np.linalg.norm(transform_points(A, points) - transform_points(B, points), axis=1).mean())


def orthonormal(T: np.ndarray) -> np.ndarray:
    """T with its rotation made exact, so that rounding does not grow from frame to frame."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T = T.copy()
    T[:3, :3] = U @ Vt
    return T


class LocalMap:
    """The last keyframes as Gaussian voxel maps of three edges.

    It is a function of ``members``, the keyframes' (index, scan, pose), alone: so it can be built again.
    """

    def __init__(self) -> None:
        self.members: list[tuple[int, Scan, np.ndarray]] = []
        self._clear()

    def _clear(self) -> None:
        self.levels = {edge: small_gicp.GaussianVoxelMap(edge) for edge in (FINE, COARSE, WIDE)}
        for level in self.levels.values():
            level.set_lru(horizon=1 << 30)
        self.planes = PlaneMap()

    def insert(self, index: int, scan: Scan, T: np.ndarray) -> None:
        self.members.append((index, scan, T))
        added = self.members[-1:]
        if len(self.members) >= 2 * MAP_KEYFRAMES:
            self._clear()
            added = self.members = self.members[-MAP_KEYFRAMES:]
        for _, old, pose in added:
            for level in self.levels.values():
                level.insert(old.cloud, pose)
            self.planes.insert(old.points, old.normals, pose)

    def fit(self, scan: Scan, T: np.ndarray, edges: tuple[float, ...], start: str) -> Fit:
        for edge in edges:
            found = small_gicp.align(
                self.levels[edge], scan.cloud, T, max_correspondence_distance=REACH * edge, num_threads=1,
                max_iterations=30, rotation_epsilon=1e-4 * edge, translation_epsilon=1e-2 * edge,
            )  # fmt: skip
            T = found.T_target_source
        inliers = max(found.num_inliers, 1)
        return Fit(T, found.num_inliers / len(scan), found.error / inliers, start)

    def polish(self, scan: Scan, fit: Fit, slope: float) -> tuple[Fit, float]:
        """The fit with the pose that robust weights give, and how the residuals grow with range (see ``planes``)."""
        T, rms, slope = self.planes.fit(scan.points, scan.normals, scan.ranges, fit.T, slope)
        return replace(fit, T=orthonormal(T), rms=rms), slope


class Odometry:
    """Registers scans, in their order, into the frame of the first one."""

    def __init__(self, voxel: float, origin: np.ndarray) -> None:
        """voxel: the working edge (see ``choose_voxel``); origin: (3,) near the first scan's middle; file units."""
        self.voxel, self.origin = voxel, origin
        self.map = LocalMap()
        self.poses: list[np.ndarray] = []  # the last two, in voxels
        self.last: tuple[int, Scan, np.ndarray]  # index, scan, pose: the last one that could be used
        self.aligned = self.uncertain = 0  # frames in a row
        self.errors: deque[float] = deque(maxlen=5)  # of the last predictions
        self.usual: deque[tuple[float, float]] = deque(maxlen=15)  # overlap and total of the last aligned frames
        self.slopes: deque[float] = deque(maxlen=15)
        self.fresh = np.inf  # the best fit's total since the last keyframe
        self.index = 0

    def prepare(self, points: np.ndarray) -> Scan | None:
        """Thin points (N, 3) and estimate their covariances; None where too little is left. Safe in another thread."""
        scan = (
            Scan((points - self.origin) / self.voxel, -self.origin / self.voxel) if len(points) >= MIN_POINTS else None
        )
        return scan if scan and len(scan) >= MIN_POINTS else None

    def register(self, scan: Scan | None) -> Frame:
        """The next frame; None stands for a scan that could not be used, and is bridged by the prediction."""
        index, self.index = self.index, self.index + 1
        if not self.poses:
            if scan is None:
                raise RegistrationError("the first scan has too few points to start from, leave it out with --start")
            self.map.insert(index, scan, np.eye(4))
            self.poses, self.last, self.aligned = [np.eye(4)], (index, scan, np.eye(4)), 1
            return Frame(np.eye(4), "aligned", 1.0, 0.0, "first")
        predicted = self.predict()
        if scan is None:
            return self._bridge(index, None, predicted, Fit(predicted, 0.0, np.nan, "prediction"), None)
        fit, feature_errors = self._best_fit(scan, predicted)
        if not self._fits(fit):
            return self._bridge(index, scan, predicted, fit, feature_errors)
        fit, slope = self.map.polish(scan, fit, float(np.median(self.slopes)) if self.slopes else 0.0)
        if np.isfinite(slope):
            self.slopes.append(slope)
        self._accept(index, scan, predicted, fit)
        return self._frame(fit.T, "aligned", fit, feature_errors)

    def predict(self) -> np.ndarray:
        """The last motion again."""
        last = self.poses[-1]
        return last if len(self.poses) < 2 else orthonormal(last @ np.linalg.inv(self.poses[-2]) @ last)

    def _best_fit(self, scan: Scan, predicted: np.ndarray) -> tuple[Fit, FeatureErrors]:
        """Trust the prediction while predictions have been good; else compare starts by what they come to."""
        expected = 3 * max(self.errors, default=np.inf)
        fits = []
        if self.aligned > 2:
            fit = self.map.fit(scan, predicted, (FINE,) if expected < FINE else (COARSE, FINE), "prediction")
            if self._usual(fit) and displacement(fit.T, predicted, scan.points) < expected + COARSE:
                return fit, None
            fits = [fit]
        starts = {"prediction": predicted, "still": self.poses[-1]} if len(self.poses) > 1 else {"still": predicted}
        fits += [self.map.fit(scan, T, (WIDE, COARSE, FINE), name) for name, T in starts.items()]
        best = min(fits, key=lambda fit: fit.total)
        agreed = len(fits) > 1 and all(displacement(fit.T, best.T, scan.points) < FINE / 2 for fit in fits)
        if self._fits(best) and (agreed or best.total < CONVINCING):
            return best, None
        T, feature_errors = self._feature_start(scan)
        return min(best, self.map.fit(scan, T, (COARSE, FINE), "features"), key=lambda fit: fit.total), feature_errors

    def _feature_start(self, scan: Scan) -> tuple[np.ndarray, FeatureErrors]:
        """Where feature-metric registration puts the scan, by the last one that could be used."""
        from fmr_cli.registration.options import Options
        from fmr_cli.registration.pipeline import align

        _, last, pose = self.last
        found = align(scan.prepared, last.prepared, Options(refine=False))
        return pose @ found.T_target_source, (found.feature_error_before, found.feature_error_after)

    def _fits(self, fit: Fit) -> bool:
        usual = float(np.median([overlap for overlap, _ in self.usual])) if self.usual else 0.0
        return fit.overlap >= max(MIN_OVERLAP, OVERLAP_DROP * usual) and fit.cost <= MAX_COST

    def _usual(self, fit: Fit) -> bool:
        """Whether the fit is as good as the last ones; a scanner's rings on the ground hold it where it was, too."""
        overlap, total = np.median(self.usual, axis=0)
        return self._fits(fit) and fit.overlap > DOUBTFUL_OVERLAP * overlap and fit.total < DOUBTFUL_TOTAL * total

    def _accept(self, index: int, scan: Scan, predicted: np.ndarray, fit: Fit) -> None:
        if len(self.poses) > 1:
            self.errors.append(displacement(fit.T, predicted, scan.points))
        self.usual.append((fit.overlap, fit.total))
        self.aligned, self.uncertain = self.aligned + 1, 0
        self.poses, self.last = [self.poses[-1], fit.T], (index, scan, fit.T)
        self.fresh = min(self.fresh, fit.total)
        _, _, key = self.map.members[-1]
        if fit.total > KEYFRAME_RISE * self.fresh or displacement(fit.T, key, scan.points) > KEYFRAME_MOTION:
            self.map.insert(index, scan, fit.T)
            self.fresh = np.inf

    def _bridge(
        self, index: int, scan: Scan | None, predicted: np.ndarray, fit: Fit, feature_errors: FeatureErrors
    ) -> Frame:
        self.aligned, self.uncertain = 0, self.uncertain + 1
        self.poses = [self.poses[-1], predicted]
        if scan is not None:
            self.last = (index, scan, predicted)
            if self.uncertain >= LOST_AFTER:  # the old map is out of sight: what follows is at least right in itself
                self.map, self.uncertain, self.fresh = LocalMap(), 0, np.inf
                self.map.insert(index, scan, predicted)
                self.usual.clear()
        return self._frame(predicted, "uncertain", fit, feature_errors)

    def _frame(self, T: np.ndarray, status: str, fit: Fit, feature_errors: FeatureErrors) -> Frame:
        return Frame(self.to_file(T), status, fit.overlap, fit.rms * self.voxel, fit.start, feature_errors)

    def state(self) -> dict[str, Any]:
        """What ``restore`` needs besides every frame's pose in voxels (``poses[-1]`` after each); JSON types."""
        return {
            "aligned": self.aligned,
            "uncertain": self.uncertain,
            "errors": list(self.errors),
            "usual": list(self.usual),
            "slopes": list(self.slopes),
            "fresh": self.fresh,
            "last": self.last[0],
            "map": [index for index, _, _ in self.map.members],
        }

    def restore(self, state: dict[str, Any], poses: list[np.ndarray], load: Callable[[int], Scan]) -> None:
        """Go on exactly as after the frame that ``state`` was taken at.

        poses: of every frame so far, in voxels; load: gives a frame's scan as ``prepare`` made it.
        """
        self.index, self.poses = len(poses), poses[-2:]
        self.aligned, self.uncertain, self.fresh = state["aligned"], state["uncertain"], state["fresh"]
        self.errors.extend(state["errors"])
        self.usual.extend((overlap, total) for overlap, total in state["usual"])
        self.slopes.extend(state["slopes"])
        for index in state["map"]:
            self.map.insert(index, load(index), poses[index])
        self.last = (state["last"], load(state["last"]), poses[state["last"]])

    def to_file(self, T: np.ndarray) -> np.ndarray:
        """A pose in voxels about the first scan's centre as one in file units about the file's origin."""
        pose = T.copy()
        pose[:3, 3] = self.voxel * T[:3, 3] + self.origin - T[:3, :3] @ self.origin
        return pose

    def to_voxels(self, pose: np.ndarray) -> np.ndarray:
        """The inverse of ``to_file``."""
        T = pose.copy()
        T[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ self.origin - self.origin) / self.voxel
        return T
