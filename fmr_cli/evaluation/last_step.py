"""The last step of a registration, ways to take it compared: each from the same start near the pose.

Under noise, thinning and outliers, and between a noisy sensor and a clean one; beside it the limit that noise sets.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import RegistrationError
from fmr_cli.evaluation.cramer_rao import information, median_rotation
from fmr_cli.evaluation.experiments import Experiment, Row, make_row
from fmr_cli.evaluation.heldout import Errors
from fmr_cli.geometry.normals import neighbours, normals_and_variation
from fmr_cli.geometry.point_to_plane import constrained
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.se3 import log
from fmr_cli.registration import refinement
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.synthetic import near_pairs
from fmr_cli.synthetic.near_pairs import Degraded, NearPair, TwoSamples

if TYPE_CHECKING:
    from fmr_cli.evaluation.experiments import Clouds

MADE_UP = "made up"  # the name of the set where no scans are given
POINTS = 8192  # of each cloud, unless said: 1024, as of the other experiments, are too few to average noise out

_WITH_LIMIT = (
    ("rotation_median", "median rotation error, deg"),
    ("shift_median", "median shift error"),
    ("limit_ratio", "times the Cramér-Rao limit"),
)
_WITHOUT = _WITH_LIMIT[:2]
_NOISE = (0.005, 0.01, 0.02, 0.04)
EXPERIMENTS = {
    e.name: e
    for e in (
        Experiment("refine-noise", "noise of both", tuple((v, Degraded(v)) for v in (0.0, *_NOISE)), _WITH_LIMIT),
        Experiment(
            "refine-density", "share of the source's points",
            tuple((v, Degraded(density=v)) for v in (1.0, 0.5, 0.25, 0.1, 0.05)), _WITHOUT,
        ),
        Experiment(
            "refine-outliers", "share of outliers",
            tuple((v, Degraded(outliers=v)) for v in (0.0, 0.1, 0.2, 0.3, 0.4)), _WITHOUT,
        ),
        Experiment("refine-sensors", "noise of the source", tuple((v, Degraded(v, 0.0)) for v in _NOISE), _WITH_LIMIT),
    )
}  # fmt: skip
TRIES = 100  # of a made-up scene: one in thirty determines no pose
TWO_SENSORS = "refine-sensors"  # on made-up scenes by two sensors; on scans, noise of the source alone

Step = Callable[[Pair, np.ndarray], np.ndarray]  # a pose between the centred frames, and a better one


def by_gicp(pair: Pair, T: np.ndarray) -> np.ndarray:
    """GICP by small_gicp, whatever the noise."""
    target = pair.target.for_gicp(refinement.GICP_TARGET, pair.edge, 1)
    return refinement.gicp_in_reach(
        pair, pair.source.fine(refinement.GICP_SOURCE, pair.edge), target, T
    ).T_target_source


def by_point_to_plane(pair: Pair, T: np.ndarray) -> np.ndarray:
    """Robust point-to-plane between the points as they are."""
    source, target = pair.source, pair.target
    s, t = source.fine(refinement.GICP_SOURCE, pair.edge), target.fine(refinement.GICP_TARGET, pair.edge)
    return constrained(s, t, T, pair.edge, np.eye(6), False)


def by_patches(pair: Pair, T: np.ndarray) -> np.ndarray:
    """The feature metric of local patches, the target's Jacobian alone, as the paper's step."""
    return refinement.by_patches(pair, T, refinement.LEVELS)


def by_patches_both(pair: Pair, T: np.ndarray) -> np.ndarray:
    """The same with the mean of both Jacobians."""
    return refinement.by_patches(pair, T, refinement.LEVELS, both=True)


def by_default(pair: Pair, T: np.ndarray) -> np.ndarray:
    """What `fmr align` does from a likely pose: point-to-plane from far to near, then the step that suits the noise."""
    return refinement.exact(pair, refinement.by_geometry(pair, refinement.by_planes(pair, T))).T_target_source


def patches_then_gicp(pair: Pair, T: np.ndarray) -> np.ndarray:
    """The feature metric from the start, geometry at the end."""
    return by_gicp(pair, by_patches(pair, T))


def default_then_patches(pair: Pair, T: np.ndarray) -> np.ndarray:
    """The feature metric has the last word."""
    return refinement.by_patches(pair, by_default(pair, T), refinement.FINE, both=True)


STEPS: dict[str, Step] = {
    "fmr align": by_default,
    "GICP": by_gicp,
    "point-to-plane": by_point_to_plane,
    "patches": by_patches,
    "patches, both J": by_patches_both,
    "patches, GICP": patches_then_gicp,
    "fmr align, patches": default_then_patches,
}


def at_level(
    experiment: Experiment[Degraded], number: int, clouds: Clouds | None, pairs: int, points: int, seed: int
) -> list[Row]:
    """Every step from the same starts of ``pairs`` pairs at one level, by its number; clouds: None for made-up ones."""
    level, how = experiment.levels[number]
    found: dict[str, list[tuple[np.ndarray, float]]] = {name: [] for name in STEPS}
    limits = []
    for n in range(pairs):
        scene, rng = np.random.default_rng((seed, n)), np.random.default_rng((seed, n, number))
        near = near_pairs.near_pair(samples(clouds, experiment.name, points, scene), how, rng)
        limits.append(limit(near))
        for name, step in STEPS.items():
            found[name].append(taken(near, step))
    rows = []
    for name, results in found.items():
        errors = np.stack([error for error, _ in results])
        e = Errors(*errors.T)
        ratio = float(np.median(e.rotation / limits)) if np.all(limits) else None
        rows.append(make_row(
            experiment, clouds.name if clouds else MADE_UP, name, level, e, e.success,
            float(np.mean([seconds for _, seconds in results])), limit_median=float(np.median(limits)),
            limit_ratio=ratio,
        ))  # fmt: skip
    return rows


def samples(clouds: Clouds | None, experiment: str, points: int, rng: np.random.Generator) -> TwoSamples:
    """Two samples of a made-up scene, or of one of the clouds (whose normals are those of all its points)."""
    if clouds is None:
        make = near_pairs.two_sensors if experiment == TWO_SENSORS else near_pairs.made_up
        return next(drawn for drawn in (make(rng, points) for _ in range(TRIES)) if drawn.determined)
    cloud = clouds.points[int(rng.integers(len(clouds.points)))].double().cpu().numpy()
    normals = normals_and_variation(cloud, *neighbours(cloud, cKDTree(cloud)))[0]
    return near_pairs.halves(cloud, normals, points, rng)


def limit(near: NearPair) -> float:
    """The median rotation error that the pair's noise allows, degrees; 0 without noise."""
    if not near.variance:
        return 0.0
    return median_rotation(information(near.common, near.normals, near.variance))


def taken(near: NearPair, step: Step) -> tuple[np.ndarray, float]:
    """The error that a step leaves: degrees, shift of the middle and RMSE of the twist, lengths in sizes; seconds.

    Each step has clouds of its own, so that none finds what another one has worked out. Where it cannot be taken at
    all, the start's error stays.
    """
    T, seconds = near.start, 0.0
    try:
        pair = make_pair(Prepared(PointCloud(near.source)), Prepared(PointCloud(near.target)), Options())
        start = pair.enter_centred(near.start)
        begin = time.perf_counter()
        T = pair.leave_centred(step(pair, start))
        seconds = time.perf_counter() - begin
    except RegistrationError:
        pass
    return np.array(normalised_error(T, near.T_target_source, near.target.mean(0), near.size)), seconds


def normalised_error(
    T_found: np.ndarray, T_true: np.ndarray, centre: np.ndarray, size: float
) -> tuple[float, float, float]:
    """Degrees, the shift of the target's ``centre``, and the RMSE of the twist about it, lengths in ``size``."""
    into = np.eye(4)
    into[:3, 3] = -centre
    off = into @ T_found @ np.linalg.inv(T_true) @ np.linalg.inv(into)
    off[:3, 3] /= size
    degrees, shift = pose_error(off, np.eye(4))
    return float(degrees), float(shift), float(np.sqrt((log(off) ** 2).mean()))
