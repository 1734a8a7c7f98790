"""Places seen before: sought where the path comes near itself and by what they look like, and proved by registration.

A loop is believed where the verdict of ``align`` is "aligned", the map of the place agrees with it and the path may
have drifted so far; one that the path did not expect, only where another one tells the same. What agrees so and lies
further off than any path drifts are two places that look alike, as the aisles of a warehouse do: how far these lie
apart shows what would be taken for a loop there. Loops are closed by a pose graph (GTSAM), each with the information
that the scan has at the place; while one does not fit the closed path, the worst is dropped (Baarda's data snooping: a
robust kernel would rather believe the path, whose drift is no noise). Lengths are in voxels and poses are T_map_scan,
as in ``odometry``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fmr_cli.geometry.se3 import adjoint
from fmr_cli.multiway import looks
from fmr_cli.multiway.pose_graph import bounded, prior_factor, symmetric
from fmr_cli.registration.models import local_encoder
from fmr_cli.registration.options import Options
from fmr_cli.sequence.local_map import COARSE, FINE, LocalMap, displacement
from fmr_cli.sequence.prepared_scan import PreparedScan

# Set by hand on simulated rounds; lengths in voxels.
SPACING = 10.0  # between the keyframes that loops are sought for
RADIUS, DRIFT = 25.0, 0.02  # how near a place must seem: a distance, and a share of the path since
MOST_DRIFT = 0.1  # of the path: what looks like a place further off than that is another one
DETOUR = 4.0  # a loop's path is at least so many times that distance
NEIGHBOURS = 2  # keyframes on either side that make up the place's map
AGREE = 2.0  # so near must the place's map put the scan to where registration puts it; and a closed path to its loops
REST = 3  # keyframes after a loop in which no other is sought: they would say the same
LOOKALIKES = 20  # places that only look alike, the most promising, that are registered
EDGE = 2.0  # of the grid on which places are described
STEP_SIGMA = np.array([1e-3] * 3 + [2e-2] * 3)  # radians, voxels: of the motion between two frames
GAP_SIGMA = 100 * STEP_SIGMA  # where one of them is uncertain


@dataclass(frozen=True)
class Loop:
    """Frame ``later`` seen from frame ``earlier``: T_earlier_later (4, 4).

    information: (6, 6) of a twist (omega, v) on its left. between: length of the path from the one to the other; off:
    how far the path puts the later one from there. expected: whether the path comes near itself there.
    """

    earlier: int
    later: int
    T_earlier_later: np.ndarray
    information: np.ndarray
    between: float
    off: float
    expected: bool = True

    @property
    def possible(self) -> bool:
        """Whether the path may have drifted so far."""
        return self.off <= AGREE + (DRIFT if self.expected else MOST_DRIFT) * self.between

    @property
    def confused(self) -> bool:
        """Whether no path drifts so far: two places that look alike."""
        return self.off > AGREE + MOST_DRIFT * self.between


def close_loops(
    poses: np.ndarray, sure: np.ndarray, load: Callable[[int], PreparedScan], pair: Options = Options()
) -> tuple[np.ndarray, list[Loop]]:
    """Poses (n, 4, 4) with their loops closed, and the loops.

    sure: (n,), False where a pose is no more than a prediction. load: gives a frame's scan.
    pair: how two of them are registered.
    """
    keys = keyframes(poses, sure)
    path = path_lengths(poses)
    load = lru_cache(maxsize=4 * NEIGHBOURS + 2)(load)
    near = candidates(poses, keys)
    seen = proved(near, poses, keys, load, pair, expected=True)
    alike = [pair for pair in lookalikes(path, keys, load, pair) if pair not in near]
    seen += proved(alike, poses, keys, load, pair, expected=False)
    loops = believed(seen)
    loops = [loop for loop in loops if loop.expected or confirmed(loop, loops, poses, path)]
    while loops:
        closed = optimise(poses, sure, loops)
        off = [apart(loop, closed, load(loop.later).points) for loop in loops]
        if max(off) <= AGREE:
            return closed, loops
        del loops[int(np.argmax(off))]
    return poses, []


def path_lengths(poses: np.ndarray) -> np.ndarray:
    """(n,): how far each of the poses (n, 4, 4) is along the path."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])


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
    path = path_lengths(poses)
    found = []
    for later in range(1, len(keys)):
        apart = np.linalg.norm(centres[keys[:later]] - centres[keys[later]], axis=1)
        between = path[keys[later]] - path[keys[:later]]
        near = RADIUS + DRIFT * between
        apart[(apart > near) | (between < DETOUR * near)] = np.inf
        if np.isfinite(apart).any():
            found.append((int(np.argmin(apart)), later))
    return found


def lookalikes(
    path: np.ndarray, keys: list[int], load: Callable[[int], PreparedScan], pair: Options
) -> list[tuple[int, int]]:
    """Keyframes far apart along the path that look most like one place, as places in ``keys``: (earlier, later)."""
    if len(keys) < 2:
        return []
    from fmr_cli.geometry.motion import Motion

    described = [looks.describe(load(key).for_align, EDGE, local_encoder(pair.model)) for key in keys]
    alike = looks.similarity(described)
    found = []
    for later in range(1, len(keys)):
        score = np.where(path[keys[later]] - path[keys[:later]] < DETOUR * RADIUS, -np.inf, alike[later, :later])
        if np.isfinite(score).any():
            earlier = int(np.argmax(score))
            found.append((looks.look(described[later], described[earlier], Motion()).promise, earlier, later))
    best = sorted(found, reverse=True)[:LOOKALIKES]
    return sorted(((earlier, later) for _, earlier, later in best), key=lambda pair: pair[1])


def proved(
    pairs: list[tuple[int, int]], poses: np.ndarray, keys: list[int], load: Callable[[int], PreparedScan],
    pair: Options, *, expected: bool,
) -> list[Loop]:  # fmt: skip
    """What registration takes for loops among pairs of places in ``keys``, each (earlier, later), by the later one."""
    loops: list[Loop] = []
    last = -REST - 1
    for earlier, later in pairs:
        if later - last <= REST:
            continue
        loop = verify(poses, keys, earlier, later, load, pair, expected)
        if loop is not None:
            loops.append(loop)
            last = later if loop.possible else last
    return loops


def believed(seen: list[Loop]) -> list[Loop]:
    """The possible ones, nearer to the path than half the way from a place to the nearest that looks like it."""
    confusion = min((loop.off for loop in seen if loop.confused), default=np.inf)
    return [loop for loop in seen if loop.possible and loop.off < confusion / 2]


def verify(
    poses: np.ndarray, keys: list[int], earlier: int, later: int, load: Callable[[int], PreparedScan], pair: Options,
    expected: bool,
) -> Loop | None:  # fmt: skip
    """The loop of two keyframes, or None where registration does not say surely that they show one place."""
    from fmr_cli.registration import align

    scan = load(keys[later])
    found = align(scan.for_align, load(keys[earlier]).for_align, pair, hints=False)
    if found.status != "aligned":
        return None
    T_earlier_map = np.linalg.inv(poses[keys[earlier]])
    off = float(np.linalg.norm((T_earlier_map @ poses[keys[later]] - found.T_target_source)[:3, 3]))
    between = float(path_lengths(poses[keys[earlier] : keys[later] + 1])[-1])
    place = LocalMap()
    for key in keys[max(earlier - NEIGHBOURS, 0) : min(earlier + NEIGHBOURS + 1, later)]:
        place.insert(key, load(key), T_earlier_map @ poses[key])
    fit = place.polish(scan, place.fit(scan, found.T_target_source, (COARSE, FINE), "features"), 0.0)[0]
    if fit.seen is None or displacement(fit.T_map_scan, found.T_target_source, scan.points) > AGREE:
        return None
    about = np.eye(6)  # a twist about the origin as one about the points' centre
    about[3:, :3] = np.cross(np.eye(3), fit.seen.centre).T
    information = about.T @ bounded(fit.seen.information, fit.seen.radius, FINE) @ about
    return Loop(keys[earlier], keys[later], fit.T_map_scan, information, between, off, expected)


def confirmed(loop: Loop, loops: list[Loop], poses: np.ndarray, path: np.ndarray) -> bool:
    """Whether another loop tells the same, as far as the path from the one to the other allows to tell."""
    for other in loops:
        if other is loop:
            continue
        T = np.linalg.inv(poses[other.earlier]) @ poses[loop.earlier] @ loop.T_earlier_later
        T = T @ np.linalg.inv(poses[loop.later]) @ poses[other.later]
        off = np.linalg.norm((np.linalg.inv(other.T_earlier_later) @ T)[:3, 3])
        between = abs(path[loop.later] - path[other.later]) + abs(path[loop.earlier] - path[other.earlier])
        if off < AGREE + DRIFT * between:
            return True
    return False


def apart(loop: Loop, poses: np.ndarray, points: np.ndarray) -> float:
    """How far, voxels, a path puts a loop's later scan of points (N, 3) from where the loop puts it."""
    return displacement(np.linalg.inv(poses[loop.earlier]) @ poses[loop.later], loop.T_earlier_later, points)


def optimise(poses: np.ndarray, sure: np.ndarray, loops: list[Loop]) -> np.ndarray:
    """The poses (n, 4, 4) that agree best with every motion between frames and with the loops; the first stays."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(prior_factor(0, poses[0], np.eye(6) * 1e18))
    for i, pose in enumerate(poses):
        values.insert(i, gtsam.Pose3(pose))
        if i:
            sigma = STEP_SIGMA if sure[i] and sure[i - 1] else GAP_SIGMA
            step = gtsam.Pose3(np.linalg.inv(poses[i - 1]) @ pose)
            graph.add(gtsam.BetweenFactorPose3(i - 1, i, step, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    for loop in loops:
        A = adjoint(loop.T_earlier_later)
        noise = gtsam.noiseModel.Gaussian.Information(symmetric(A.T @ loop.information @ A))
        graph.add(gtsam.BetweenFactorPose3(loop.earlier, loop.later, gtsam.Pose3(loop.T_earlier_later), noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([found.atPose3(i).matrix() for i in range(len(poses))])
