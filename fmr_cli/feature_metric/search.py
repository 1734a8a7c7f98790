"""Any initial rotation: starts spread evenly over SO(3), solved together, thinned out early, the best refined.

J belongs to the target, so that all starts share it; a start costs only encoder passes over few points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fmr_cli.feature_metric.inverse_compositional import Solution, Template
from fmr_cli.geometry.pose_error import angle_between

# 64 rotations leave none further than 60.4 deg from a start (30 on average); the solver's basin, measured, reaches 60.
STARTS = 64
# (points, iterations, distinct poses kept) of each round; the last takes all points.
ROUNDS = ((128, 4, 16), (256, 5, 6), (None, 10, 6))
APART = math.radians(10.0)  # poses nearer than this are one


class Solver(Protocol):
    """What solves from given starts: ``numpy_solver.NumpySolver``, or ``solver.OnDevice`` on a GPU."""

    def template(self, target: np.ndarray, threads: int = 1) -> Template[np.ndarray]: ...

    def solve(
        self,
        template: Template[np.ndarray],
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
        threads: int = 1,
    ) -> Solution[np.ndarray]: ...


@dataclass
class Found:
    """Distinct poses g (n, 4, 4), best first; their mean |r| (n,), and that of every iteration (i + 1, n)."""

    g: np.ndarray
    error: np.ndarray
    errors: np.ndarray


def search(
    solver: Solver,
    source: np.ndarray,
    target: np.ndarray,
    starts: np.ndarray,
    robust: bool = True,
    basis: np.ndarray | None = None,
    threads: int = 1,
) -> Found:
    """Solve from every start (S, 4, 4); source (N, 3), target (M, 3) normalised, points in random order.

    The first rounds use the first points of both; what ends with a large error goes no further.
    """
    g = starts
    for points, iterations, kept in ROUNDS:
        template = solver.template(target[:points], threads)
        found = solver.solve(template, source[:points], g, iterations, robust, basis, threads)
        order = distinct(found.g, found.error, kept)
        g = found.g[order]
    return Found(g, found.error[order], found.errors[:, order])


def distinct(g: np.ndarray, error: np.ndarray, count: int) -> list[int]:
    """Indices of the ``count`` poses of least error, no two within APART of each other."""
    kept: list[int] = []
    for i in np.argsort(error, kind="stable").tolist():
        if all(angle_between(g[i, :3, :3], g[j, :3, :3]) > APART for j in kept):
            kept.append(i)
        if len(kept) == count:
            break
    return kept
