"""Cross-source registration, the paper's Figure 8, on made-up pairs: photogrammetry onto a depth camera and a laser."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import RegistrationError
from fmr_cli.evaluation.experiments import Experiment, Row, make_row
from fmr_cli.evaluation.heldout import SUCCESS, Errors
from fmr_cli.evaluation.last_step import normalised_error
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import align
from fmr_cli.synthetic.cross_source import SENSORS, CrossSourcePair, cross_source_pair

RIGHT_SHIFT = 0.02  # of the target's largest extent: the shift of its middle, at most
RIGHT_SCALE = 0.02  # share by which the scale is off, at most: what moves the border by half of RIGHT_SHIFT
EXPERIMENTS = {
    "cross-source": Experiment(
        "cross-source", "strength of the defects", tuple((v, v) for v in (0.5, 1.0, 2.0)),
        (("success", "share right"), ("scale_median", "median error of the scale"),
         ("aligned_right", "share aligned and right"), ("aligned_wrong", "share aligned and wrong")),
    )
}  # fmt: skip
METHODS = "fmr align --scale", "fmr align, scale known"


def at_level(experiment: Experiment[float], number: int, sensor: int, pairs: int, seed: int) -> list[Row]:
    """Both methods on the same ``pairs`` pairs onto one of SENSORS, by its number, at one level, by its number.

    Right: below 5 deg, RIGHT_SHIFT and RIGHT_SCALE.
    """
    level, strength = experiment.levels[number]
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in METHODS}
    for n in range(pairs):
        pair = cross_source_pair(SENSORS[sensor], strength, np.random.default_rng((seed, sensor, n)))
        for name in METHODS:
            found[name].append(registered(pair, known=name == METHODS[1]))
    rows = []
    for name, results in found.items():
        e = Errors(*np.array([r["error"] for r in results]).T)
        scale = np.array([r["scale"] for r in results])
        aligned = np.array([r["aligned"] for r in results])
        right = (e.rotation < SUCCESS) & (e.translation < RIGHT_SHIFT) & (scale < RIGHT_SCALE)
        rows.append(make_row(
            experiment, f"onto a {SENSORS[sensor]}", name, level, e, float(right.mean()),
            float(np.mean([r["seconds"] for r in results])), scale_median=float(np.median(scale)),
            aligned_right=float((aligned & right).mean()), aligned_wrong=float((aligned & ~right).mean()),
        ))  # fmt: skip
    return rows


def registered(pair: CrossSourcePair, known: bool) -> dict[str, Any]:
    """error: as ``normalised_error``, of the rigid part; scale: the share by which it is off; aligned; seconds.

    known: the source comes in the target's unit.
    """
    unit = np.diag([*[pair.scale if known else 1.0] * 3, 1.0])
    begin = time.perf_counter()
    try:
        source = PointCloud(pair.source * unit[0, 0])
        found = align(source, PointCloud(pair.target), Options(scale=not known), threads=1)
        T, aligned = found.T_target_source @ unit, found.status == "aligned"
    except RegistrationError:  # what cannot be registered is half a turn off
        T, aligned = np.diag([-1.0, -1.0, 1.0, 1.0]) @ pair.T_target_source, False
    seconds = time.perf_counter() - begin
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])) / pair.scale)
    middle = pair.target.mean(0)
    # The rigid motion left over that puts the middle where the found similarity does
    rest = T @ np.linalg.inv(pair.T_target_source)
    moved = rest[:3, :3] @ middle + rest[:3, 3]
    rest[:3, :3] /= scale
    rest[:3, 3] = moved - rest[:3, :3] @ middle
    error = normalised_error(rest, np.eye(4), middle, pair.size)
    return {"error": error, "scale": abs(scale - 1), "aligned": aligned, "seconds": seconds}
