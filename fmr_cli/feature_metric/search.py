"""Any initial rotation: starts spread evenly over SO(3), solved as one batch, thinned out early, the best refined.

J belongs to the target, so that all starts share it; a start costs only encoder passes over few points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.motion import rotation_between
from fmr_cli.feature_metric.solver import make_template, solve

# 64 rotations leave none further than 60.4 deg from a start (30 on average); the solver's basin, measured, reaches 60.
STARTS = 64
COARSE_POINTS, COARSE_ITERATIONS = 256, 6
KEPT, FINE_ITERATIONS = 6, 15
APART = math.radians(10.0)  # poses nearer than this are one


@dataclass
class Found:
    """Distinct poses g (n, 4, 4), best first; their mean |r| (n,), and that of every iteration (i + 1, n)."""

    g: Tensor
    error: Tensor
    errors: Tensor


def search(
    encoder: Encoder,
    source: Tensor,
    target: Tensor,
    starts: Tensor,
    robust: bool = True,
    basis: Tensor | None = None,
) -> Found:
    """Solve from every start (S, 4, 4); source (1, N, 3), target (1, M, 3) normalised, points in random order.

    The coarse round uses the first COARSE_POINTS of both; the best KEPT are refined on all points.
    """
    starts = starts.to(source)
    template = make_template(encoder, target[:, :COARSE_POINTS])
    few = source[:, :COARSE_POINTS].expand(len(starts), -1, -1)
    coarse = solve(encoder, template, few, starts, COARSE_ITERATIONS, robust, basis)
    best = distinct(coarse.g, coarse.error, KEPT)
    all_points = source.expand(len(best), -1, -1)
    fine = solve(encoder, make_template(encoder, target), all_points, coarse.g[best], FINE_ITERATIONS, robust, basis)
    order = distinct(fine.g, fine.error, KEPT)
    return Found(fine.g[order], fine.error[order], fine.errors[:, order])


def distinct(g: Tensor, error: Tensor, count: int) -> Tensor:
    """Indices of the ``count`` poses of least error, no two within APART of each other."""
    kept: list[int] = []
    for i in torch.argsort(error, stable=True).tolist():
        R = g[i, :3, :3]
        if all(float(rotation_between(R, g[j, :3, :3])) > APART for j in kept):
            kept.append(i)
        if len(kept) == count:
            break
    return torch.tensor(kept)
