"""The poses that agree best with all links (GTSAM): robust, each link with its own information; links that don't fit.

Poses are T_component_scan between centred frames. A perturbation is a twist (rotation, translation) on the right, in
the scan's own centred frame, as GTSAM has it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fmr_cli.errors import FmrError
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.se3 import adjoint

EXACT = 1e-9  # sigma, edges and radians, of what is told not to move
ROBUST = 3.0  # sigmas from which Cauchy's kernel lets a link lose weight
NARROW, WIDE = 0.02, 10.0  # edges: no link is surer than the first; directions left open get the second
TINY = 1e-13  # of the normal equations' diagonal, added so that what nothing determines is a large number, not none
LEVEL = 1e-4  # rad, and edges: how far what ``dof`` forbids may move


@dataclass(frozen=True)
class Factor:
    """One measured relative pose. information: (6, 6) of a twist on the left, in the target's centred frame."""

    source: int
    target: int
    T_target_source: np.ndarray
    information: np.ndarray


@dataclass(frozen=True)
class Prior:
    """A pose known beforehand, with its sigmas: radians, file's unit."""

    scan: int
    T_component_scan: np.ndarray
    sigma_rot: float
    sigma_shift: float


@dataclass
class Solution:
    """T_component_scan by scan; covariance: (6, 6) by scan, of a twist on the right.

    apart: by factor, the T_target_source (4, 4) that all the others alone would have; None where they say nothing.
    """

    T_component_scan: dict[int, np.ndarray]
    covariance: dict[int, np.ndarray]
    apart: list[np.ndarray | None]


def check_installed(what: str) -> None:
    """Raises FmrError where GTSAM, which ``what`` needs, is not installed."""
    if importlib.util.find_spec("gtsam") is None:
        raise FmrError(f"{what} needs gtsam, which has no wheel for this platform; pip install gtsam from source")


def bounded(information: np.ndarray, radius: float, edge: float) -> np.ndarray:
    """Information whose sigmas lie between NARROW and WIDE edges in every direction, at ``radius`` from the centre."""
    S = np.diag([1 / radius] * 3 + [1.0] * 3)
    values, V = np.linalg.eigh(S @ information @ S)
    values = np.clip(values, 1 / (WIDE * edge) ** 2, 1 / (NARROW * edge) ** 2)
    inverse = np.diag([radius] * 3 + [1.0] * 3)
    return inverse @ (V * values) @ V.T @ inverse


def optimise(
    T_component_scan: dict[int, np.ndarray],
    factors: Sequence[Factor],
    priors: Sequence[Prior],
    held: set[int],
    motion: Motion,
    edge: float,
    robust: bool = True,
) -> Solution:
    """The most probable poses from the given ones. held: scans that don't move; edge: typical, for scale."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, pose in sorted(T_component_scan.items()):
        values.insert(i, gtsam.Pose3(pose))
    for i in sorted(held):
        graph.add(prior_factor(i, T_component_scan[i], np.eye(6) / EXACT**2))
    for prior in priors:
        sigma = np.array([prior.sigma_rot] * 3 + [prior.sigma_shift] * 3)
        graph.add(prior_factor(prior.scan, prior.T_component_scan, np.diag(1 / np.maximum(sigma, EXACT) ** 2)))
    forbidden = np.eye(6) - motion.basis() @ motion.basis().T
    if np.any(forbidden):
        for i in sorted(set(T_component_scan) - held):
            turn = np.kron(np.eye(2), T_component_scan[i][:3, :3])  # what is forbidden in the component's frame
            allowed = turn.T @ (forbidden / np.array([LEVEL**2] * 3 + [(LEVEL * edge) ** 2] * 3)) @ turn
            graph.add(prior_factor(i, T_component_scan[i], allowed + 1e-9 * np.eye(6)))
    for factor in factors:
        A = adjoint(factor.T_target_source)
        noise = gtsam.noiseModel.Gaussian.Information(symmetric(A.T @ factor.information @ A))
        if robust:
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST), noise)
        measured = gtsam.Pose3(factor.T_target_source)
        graph.add(gtsam.BetweenFactorPose3(factor.target, factor.source, measured, noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    poses = {i: found.atPose3(i).matrix() for i in sorted(T_component_scan)}
    full = covariance_of(graph.linearize(found).hessian(in_order(poses))[0])
    place = {i: slice(6 * n, 6 * n + 6) for n, i in enumerate(poses)}

    def joint(i: int, j: int) -> np.ndarray:
        return np.block([[full[place[a], place[b]] for b in (i, j)] for a in (i, j)])

    covariance = {i: full[place[i], place[i]] for i in poses}
    return Solution(poses, covariance, [without(f, poses, joint(f.source, f.target), robust) for f in factors])


def in_order(scans: Iterable[int]) -> Any:
    """The scans as GTSAM wants an order."""
    import gtsam

    ordering = gtsam.Ordering()
    for i in scans:
        ordering.push_back(i)
    return ordering


def covariance_of(H: np.ndarray) -> np.ndarray:
    """The inverse of the normal equations (n, n), in units in which their diagonal is 1.

    Dense: 1,200 unknowns of 200 scans take 0.1 s; and unlike GTSAM's own it copes with links that have lost all but a
    billionth of their weight beside others that have not.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(H), TINY**2 * np.diag(H).max()))
    factor = cho_factor(H * np.outer(scale, scale) + TINY * np.eye(len(H)), lower=True)
    return np.asarray(cho_solve(factor, np.eye(len(H)))) * np.outer(scale, scale)


def without(factor: Factor, poses: dict[int, np.ndarray], joint: np.ndarray, robust: bool) -> np.ndarray | None:
    """T_target_source of a factor as the rest of the network has it, from the adjusted network (Baarda's test).

    joint: covariance (12, 12) of its source and target. What the network says is the mean of the factor and the rest,
    weighted by their information; so the rest is what is left of it without the factor's share. None where the rest
    says next to nothing.
    """
    import gtsam

    i, j = factor.source, factor.target
    T = np.linalg.inv(poses[j]) @ poses[i]
    A = np.hstack([adjoint(T), -np.eye(6)])  # a twist on the left of T, in the target's frame
    off = gtsam.Pose3.Logmap(gtsam.Pose3(factor.T_target_source @ np.linalg.inv(T)))  # measured, on the left of T
    weight = ROBUST**2 / (ROBUST**2 + off @ factor.information @ off) if robust else 1.0
    redundancy = np.eye(6) - (A @ joint @ A.T) @ (weight * factor.information)
    U, s, Vt = np.linalg.svd(redundancy)
    if s[-1] < 0.05:
        told = s >= 0.05
        if told.sum() < 3:
            return None
        away = Vt[told].T @ ((U[:, told].T @ off) / s[told])
    else:
        away = np.linalg.solve(redundancy, off)
    # measured = exp(off) T; the rest has it at exp(off - away) T, so that away is what they differ by.
    return gtsam.Pose3.Expmap(off - away).matrix() @ T


def prior_factor(scan: int, pose: np.ndarray, information: np.ndarray) -> object:
    import gtsam

    return gtsam.PriorFactorPose3(
        scan, gtsam.Pose3(pose), gtsam.noiseModel.Gaussian.Information(symmetric(information))
    )


def symmetric(A: np.ndarray) -> np.ndarray:
    return (A + A.T) / 2
