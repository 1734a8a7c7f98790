"""The local map as small planes, one a voxel, and the robust point-to-plane alignment that a frame's pose ends with.

Lengths are in voxels. small_gicp's voxel maps reach a pose from far; but they weigh every correspondence alike, so a
few wrong ones, or a depth camera's distorted far points, move the result by more than all the others allow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.kernels import NORMAL, geman_mcclure
from fmr_cli.geometry.point_to_plane import linearise, normal_equations, step_motion
from fmr_cli.geometry.se3 import adjoint, exp
from fmr_cli.geometry.voxels import voxel_keys
from fmr_cli.sequence.deskew import deskew
from fmr_cli.sequence.observability import LEAST_SIGMA, Matches
from fmr_cli.sequence.prepared_scan import PreparedScan

REACH = 1.5  # a point's plane is sought within
FLAT = 0.8  # length of the mean normal, below which a voxel holds no plane
AGREE = 0.7  # cosine between the normals of a point and of its plane
ROUNDS, STEPS = 5, 2  # of looking up planes, at most, and of solving in between
STILL = np.array([2e-4] * 3 + [1e-2] * 3)  # radians, voxels: a round that moves less is the last
STILL_MOVING = 5 * STILL  # likewise where the motion within the scan is sought, which is then made ready anew
MOVING_POINTS = 4_000  # of a scan, about, that tell the motion within it: it has six parameters more
KERNEL = 3.0  # residuals beyond so many sigma weigh little (Geman-McClure)
MIN_SIGMA = 0.01
MIN_SPREAD = 0.3  # of log range, to tell how residuals grow with it
# Times a residual's variance, that a motion within a scan is weighed by against the one expected: a plane of the map
# that is off is so for all points on it. By hand: of 2, 10, 40, 160 best on one made-up drive.
SHARED = 10.0
BANDS = 8  # of equal count by range from the sensor


@dataclass(frozen=True)
class VoxelSums:
    """Of the voxels that a scan has points in: keys (M,), sorted, and sums (M, 7): count, points, normals; map axes."""

    keys: np.ndarray
    sums: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, T: np.ndarray) -> VoxelSums:
        """Of points and their unit normals (N, 3), moved by T (4, 4)."""
        moved = transform_points(T, points)
        keys, inverse = np.unique(voxel_keys(moved, 1.0), return_inverse=True)
        values = np.concatenate([np.ones((len(points), 1)), moved, normals @ T[:3, :3].T], 1)
        return cls(keys, np.stack([np.bincount(inverse, column, len(keys)) for column in values.T], 1))


class PlaneMap:
    """Sums of points and normals by voxel; a point looks for the nearest mean.

    two_sided: the normals' sides mean nothing, as in a map whose sensor's places are not known.
    """

    def __init__(self, two_sided: bool = False) -> None:
        self.two_sided = two_sided
        self.keys = np.zeros(0, np.int64)  # of the voxels, sorted
        self.sums = np.zeros((0, 7))  # see ``VoxelSums``
        self.tree: small_gicp.KdTree | None = None

    def add(self, seen: VoxelSums) -> None:
        """Add what a scan has seen."""
        place = np.searchsorted(self.keys, seen.keys)
        known = place < len(self.keys)
        known[known] = self.keys[place[known]] == seen.keys[known]
        self.sums[place[known]] += seen.sums[known]
        self.keys = np.insert(self.keys, place[~known], seen.keys[~known])
        self.sums = np.insert(self.sums, place[~known], seen.sums[~known], 0)
        self.tree = None

    def _settle(self) -> None:
        """Make planes of the sums, and a tree to look them up; each coordinate in one piece, which is faster."""
        self.means = np.ascontiguousarray((self.sums[:, 1:4] / self.sums[:, :1]).T)
        length = np.linalg.norm(self.sums[:, 4:], axis=1)
        self.normals = np.ascontiguousarray((self.sums[:, 4:] / np.maximum(length, 1e-9)[:, None]).T)
        self.flat = length / self.sums[:, 0] > FLAT
        self.tree = small_gicp.KdTree(self.means.T)

    def fit(self, scan: PreparedScan, T: np.ndarray, slope: float) -> tuple[np.ndarray, float, float, Matches | None]:
        """The scan's pose near T.

        slope: how residuals grow with range in this sensor's scans, see ``trust``. Returns the pose, the RMS distance
        from the planes, this scan's own slope, and what was matched; T as it was, NaN and None where too few points lie
        on planes.
        """
        solid = np.flatnonzero(scan.solid)
        points, normals = scan.points[solid].T.copy(), scan.normals[solid].T.copy()
        band, middle = bands(scan.ranges)
        band = band[solid]
        first = np.zeros(6)
        for _ in range(ROUNDS):
            moved, facing = T[:3, :3] @ points + T[:3, 3:], T[:3, :3] @ normals
            on, plane, n = self._partners(moved, facing)
            if len(on) < 6 * BANDS:
                return T, float("nan"), float("nan"), None
            moved, facing = moved.take(on, 1), facing.take(on, 1)
            r, J = linearise(moved.T, self.means.take(plane, 1).T, n.T, np.zeros(3))
            sigma = scale_by_band(np.abs(r), band[on])
            worth, scale2 = trust(sigma, slope)[band[on]], (KERNEL * sigma[band[on]]) ** 2
            for again in range(STEPS):
                weight, rms = weighed(r, worth, scale2)
                H, gradient = normal_equations(J, r, weight)
                step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), -gradient)
                T = step_motion(step) @ T
                r = r + step @ J  # to first order; the next round starts from the pose itself
                first = step if again == 0 else first
            if (np.abs(first) < STILL).all():
                break
        spread = middle - middle.mean()
        own = float(spread @ np.log(sigma) / (spread @ spread)) if np.ptp(middle) > MIN_SPREAD else 0.0
        return T, rms, own, Matches(solid[on], moved.T, facing.T, n.T, weight / worth, rms, r)

    def fit_moving(
        self, scan: PreparedScan, T: np.ndarray, slope: float, information: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """The scan's pose near T, the motion that is left in it, and the RMS distance from the planes.

        The motion is a twist (6,) over the time of the scan, scan axes, beside what it was deskewed by. information:
        (6, 6), rad⁻² and voxel⁻², how sure it is that none is left.
        """
        assert scan.when is not None
        solid = np.flatnonzero(scan.solid)
        solid = solid[:: max(len(solid) // MOVING_POINTS, 1)]
        points, normals, when = scan.points[solid], scan.normals[solid].T.copy(), scan.when[solid]
        band = bands(scan.ranges)[0][solid]
        twist, rms = np.zeros(6), float("nan")
        first = np.zeros(12)
        for _ in range(ROUNDS):
            moved = T[:3, :3] @ deskew(points, when, exp(twist)).T + T[:3, 3:]
            on, plane, n = self._partners(moved, T[:3, :3] @ normals)
            if len(on) < 12 * BANDS:
                break
            r, J = linearise(moved.take(on, 1).T, self.means.take(plane, 1).T, n.T, np.zeros(3))
            J = np.concatenate([J, (when[on] - 0.5) * J])
            sigma = scale_by_band(np.abs(r), band[on])
            worth, scale2 = trust(sigma, slope)[band[on]], (KERNEL * sigma[band[on]]) ** 2
            to_scan = adjoint(np.linalg.inv(T))
            for again in range(STEPS):
                weight, rms = weighed(r, worth, scale2)
                H, gradient = normal_equations(J, r, weight / (SHARED * max(rms, LEAST_SIGMA) ** 2))
                H[6:, 6:] += to_scan.T @ information @ to_scan
                gradient[6:] += to_scan.T @ information @ twist
                step = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(12), -gradient)
                T, twist = step_motion(step[:6]) @ T, twist + to_scan @ step[6:]
                r = r + step @ J
                first = step if again == 0 else first
            if (np.abs(first.reshape(2, 6)) < STILL_MOVING).all():
                break
        return T, twist, rms

    def _partners(self, moved: np.ndarray, facing: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which of points (3, N), with normals (3, N), map axes, lie on planes; on which; and these planes' normals."""
        if self.tree is None:
            self._settle()
        assert self.tree
        found, squared = (column[:, 0] for column in self.tree.batch_knn_search(moved.T, 1))  # in arrays, not lists
        plane = found.astype(np.int64)
        n = self.normals.take(plane, 1)
        cosine = np.einsum("in,in->n", n, facing)
        agree = (np.abs(cosine) if self.two_sided else cosine) > AGREE
        on = np.flatnonzero(agree & (squared < REACH**2) & self.flat[plane])
        n = n.take(on, 1)
        return on, plane[on], n * np.sign(cosine[on]) if self.two_sided else n


def weighed(r: np.ndarray, worth: np.ndarray, scale2: np.ndarray) -> tuple[np.ndarray, float]:
    """Robust weights (N,) of residuals r (N,), each of ``worth`` and with a squared scale, and their weighted RMS."""
    weight = worth * geman_mcclure(r * r, scale2)
    return weight, float(np.sqrt((weight * r * r).sum() / weight.sum()))


def bands(ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of BANDS of equal count each of ranges (N,) is in, and the logarithm of each band's middle (BANDS,)."""
    ordered, count = np.sort(ranges), len(ranges)
    parts = np.arange(2 * BANDS) * count // (2 * BANDS)
    return np.searchsorted(ordered[parts[2::2]], ranges), np.log(ordered[parts[1::2]] + 1e-9)


def scale_by_band(r: np.ndarray, band: np.ndarray) -> np.ndarray:
    """Sigma (BANDS,) of the residuals |r| (n,) in each range band (n,); of all where a band has few."""
    ordered = r[np.argsort(band.astype(np.uint8), kind="stable")]
    ends = np.cumsum(np.bincount(band, minlength=BANDS))
    parts = np.split(ordered, ends[:-1])
    return np.maximum(NORMAL * np.array([median(part if len(part) > 5 else r) for part in parts]), MIN_SIGMA)


def median(values: np.ndarray) -> float:
    """The upper one of the middle two, where there are two: without the passes that numpy's takes for NaN."""
    return np.partition(values, len(values) // 2)[len(values) // 2]


def trust(sigma: np.ndarray, slope: float) -> np.ndarray:
    """What a residual in each band is worth; sigma: (BANDS,); slope: d log sigma / d log range, as measured before.

    A LiDAR's residuals grow with the range at most, as the gaps between its rays do, and far points are worth as much
    as near ones. A depth camera's grow faster, and most of that is distortion, the same in every frame: it does not
    average out, so there the near points decide.
    """
    return (sigma.min() / sigma) ** (4 * np.clip(2 * slope - 2, 0, 1))
