"""Places seen before: found among spatial neighbours, verified by registration, and closed by a pose graph (GTSAM).

Lengths are in voxels and poses are T_map_scan, as in ``odometry``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fmr_cli.sequence.local_map import COARSE, FINE, WIDE, LocalMap, displacement
from fmr_cli.sequence.prepared_scan import PreparedScan

# Set by hand on simulated rounds and on the drives of the tests; lengths in voxels.
SPACING = 10.0  # between the keyframes that loops are sought for
RADIUS, DRIFT = 25.0, 0.02  # how near a place must seem: a distance, and a share of the path since
DETOUR = 4.0  # a loop's path is at least so many times that distance
NEIGHBOURS = 2  # keyframes on either side that make up the place's map
MIN_OVERLAP, MAX_TOTAL = 0.5, 2.3  # of a loop that is believed, see ``local_map.Fit`` and ``odometry.CONVINCING``
AGREE = 1.0  # loops found from the two starts must put the scan in the same place to so much
STEP_SIGMA = np.array([1e-3] * 3 + [2e-2] * 3)  # radians, voxels: of the motion between two frames
GAP_SIGMA = 100 * STEP_SIGMA  # where one of them is uncertain
HUBER = 1.345  # sigmas, beyond which a loop's residual counts less: 95 % efficient where all are normal


@dataclass(frozen=True)
class Loop:
    """Frame ``later`` seen from frame ``earlier``: T_earlier_later (4, 4)."""

    earlier: int
    later: int
    T_earlier_later: np.ndarray


def close_loops(
    poses: np.ndarray, sure: np.ndarray, load: Callable[[int], PreparedScan]
) -> tuple[np.ndarray, list[Loop]]:
    """Poses (n, 4, 4) with their loops closed, and the loops.

    sure: (n,), False where a pose is no more than a prediction. load: gives a frame's scan.
    """
    keys = keyframes(poses, sure)
    load = lru_cache(maxsize=4 * NEIGHBOURS + 2)(load)
    loops = []
    for earlier, later in candidates(poses, keys):
        T_earlier_later = verify(poses, keys, earlier, later, load)
        if T_earlier_later is not None:
            loops.append(Loop(keys[earlier], keys[later], T_earlier_later))
    return (optimise(poses, sure, loops) if loops else poses), loops


def keyframes(poses: np.ndarray, sure: np.ndarray) -> list[int]:
    """Frames about SPACING apart, the last one among them."""
    keys: list[int] = []
    for index in np.flatnonzero(sure):
        if not keys or np.linalg.norm(poses[index][:3, 3] - poses[keys[-1]][:3, 3]) > SPACING:
            keys.append(int(index))
    last = int(np.flatnonzero(sure)[-1])
    return keys if keys[-1] == last else [*keys, last]


def candidates(poses: np.ndarray, keys: list[int]) -> list[tuple[int, int]]:
    """For each keyframe, the nearest one that lies near in space and far along the path, as places in ``keys``."""
    centres = poses[:, :3, 3]
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    found = []
    for later in range(1, len(keys)):
        apart = np.linalg.norm(centres[keys[:later]] - centres[keys[later]], axis=1)
        between = path[keys[later]] - path[keys[:later]]
        near = RADIUS + DRIFT * between
        apart[(apart > near) | (between < DETOUR * near)] = np.inf
        if np.isfinite(apart).any():
            found.append((int(np.argmin(apart)), later))
    return found


def verify(
    poses: np.ndarray, keys: list[int], earlier: int, later: int, load: Callable[[int], PreparedScan]
) -> np.ndarray | None:
    """T_earlier_later of two keyframes, or None where they do not show the same place.

    It is sought from where the odometry and from where the feature-metric registration put the scan; both must agree,
    unless the first alone is beyond doubt.
    """
    T_earlier_map = np.linalg.inv(poses[keys[earlier]])
    place = LocalMap()
    for key in keys[max(earlier - NEIGHBOURS, 0) : min(earlier + NEIGHBOURS + 1, later)]:
        place.insert(key, load(key), T_earlier_map @ poses[key])
    scan = load(keys[later])
    fits = [place.fit(scan, T_earlier_map @ poses[keys[later]], (WIDE, COARSE, FINE), "odometry")]
    fits.append(place.fit(scan, np.eye(4), (WIDE, COARSE, FINE), "same place"))
    best = min(fits, key=lambda fit: fit.total)
    if displacement(fits[0].T_map_scan, fits[1].T_map_scan, scan.points) > AGREE:
        from fmr_cli.registration import Options, align

        start = align(scan.for_align, load(keys[earlier]).for_align, Options(init="features", refine=False))
        third = place.fit(scan, start.T_target_source, (COARSE, FINE), "features")
        if displacement(best.T_map_scan, third.T_map_scan, scan.points) > AGREE:
            return None
    if best.overlap < MIN_OVERLAP or best.total > MAX_TOTAL:
        return None
    return place.polish(scan, best, 0.0)[0].T_map_scan


def optimise(poses: np.ndarray, sure: np.ndarray, loops: list[Loop]) -> np.ndarray:
    """The poses (n, 4, 4) that agree best with every motion between frames and with the loops; the first stays."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(poses[0]), gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 1e-9))))
    for i, pose in enumerate(poses):
        values.insert(i, gtsam.Pose3(pose))
        if i:
            sigma = STEP_SIGMA if sure[i] and sure[i - 1] else GAP_SIGMA
            step = gtsam.Pose3(np.linalg.inv(poses[i - 1]) @ pose)
            graph.add(gtsam.BetweenFactorPose3(i - 1, i, step, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    for loop in loops:
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(HUBER), gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMA)
        )
        graph.add(gtsam.BetweenFactorPose3(loop.earlier, loop.later, gtsam.Pose3(loop.T_earlier_later), noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([found.atPose3(i).matrix() for i in range(len(poses))])
