"""Any initial rotation: starts spread evenly over SO(3), solved together, thinned out early, the best refined.

J belongs to the target, so that all starts share it; a start costs only encoder passes over few points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fmr_cli.feature_metric.fast import Solution, Template
from fmr_cli.feature_metric.motion import rotation_between

# 64 rotations leave none further than 60.4 deg from a start (30 on average); the solver's basin, measured, reaches 60.
STARTS = 64
COARSE_POINTS, COARSE_ITERATIONS = 256, 6
KEPT, FINE_ITERATIONS = 6, 10
APART = math.radians(10.0)  # poses nearer than this are one


class Solver(Protocol):
    """F and the solver on it: ``fast.FastEncoder``, or ``solver.OnDevice`` on a GPU."""

    def __call__(self, points: np.ndarray, /) -> np.ndarray: ...

    def template(self, target: np.ndarray, threads: int = 1) -> Template: ...

    def solve(
        self,
        template: Template,
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
        threads: int = 1,
    ) -> Solution: ...


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

    The coarse round uses the first COARSE_POINTS of both; the best KEPT are refined on all points.
    """
    template = solver.template(target[:COARSE_POINTS], threads)
    coarse = solver.solve(template, source[:COARSE_POINTS], starts, COARSE_ITERATIONS, robust, basis, threads)
    best = distinct(coarse.g, coarse.error, KEPT)
    fine = solver.solve(
        solver.template(target, threads), source, coarse.g[best], FINE_ITERATIONS, robust, basis, threads
    )
    order = distinct(fine.g, fine.error, KEPT)
    return Found(fine.g[order], fine.error[order], fine.errors[:, order])


def distinct(g: np.ndarray, error: np.ndarray, count: int) -> list[int]:
    """Indices of the ``count`` poses of least error, no two within APART of each other."""
    kept: list[int] = []
    for i in np.argsort(error, kind="stable").tolist():
        if all(rotation_between(g[i, :3, :3], g[j, :3, :3]) > APART for j in kept):
            kept.append(i)
        if len(kept) == count:
            break
    return kept
