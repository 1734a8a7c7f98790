"""The search over starts: any rotation, full overlap."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.numpy_solver import NumpySolver
from fmr_cli.feature_metric.search import APART, ROUNDS, STARTS, Found, search
from fmr_cli.feature_metric.solver import OnDevice
from fmr_cli.geometry.motion import Motion, rotations
from fmr_cli.geometry.pose_error import angle_between

Problem = tuple[np.ndarray, np.ndarray, np.ndarray]  # source, target, T_target_source


def problem(cloud: np.ndarray, T: np.ndarray) -> Problem:
    """Source and target drawn apart from one shape, the source turned back by T."""
    return transform_points(np.linalg.inv(T), cloud[512:896]), cloud[:384], T


@pytest.fixture(scope="module")
def turned(bodies_numpy: np.ndarray) -> list[Problem]:
    return [problem(bodies_numpy[i], T) for i, T in enumerate(rotations(300)[[11, 97]])]


@pytest.fixture(scope="module")
def results(fast: NumpySolver, turned: list[Problem]) -> list[Found]:
    return [search(fast, source, target, rotations(STARTS)) for source, target, _ in turned]


def off(found: Found, T: np.ndarray) -> float:
    return math.degrees(angle_between(found.g[0, :3, :3], T[:3, :3]))


def test_any_rotation_is_found(results: list[Found], turned: list[Problem]) -> None:
    for found, (_, _, T) in zip(results, turned, strict=True):
        assert off(found, T) < 3


def test_other_poses_are_distinct_and_worse(results: list[Found]) -> None:
    for found in results:
        assert 1 <= len(found.g) <= ROUNDS[-1][2]
        assert (np.diff(found.error) >= 0).all()
        assert found.errors.shape[1] == len(found.g)
        np.testing.assert_array_equal(found.errors[-1], found.error)
        for i in range(len(found.g)):
            for j in range(i):
                assert angle_between(found.g[i, :3, :3], found.g[j, :3, :3]) > APART


def test_the_same_poses_every_run_and_by_torch(fast: NumpySolver, encoder: Encoder, turned: list[Problem]) -> None:
    source, target, _ = turned[0]
    one, again, by_torch = (search(s, source, target, rotations(24)) for s in (fast, fast, OnDevice(encoder)))
    assert (one.g == again.g).all()
    np.testing.assert_allclose(by_torch.g[0], one.g[0], rtol=0, atol=1e-3)


def test_a_search_about_the_vertical_keeps_it(fast: NumpySolver, bodies_numpy: np.ndarray) -> None:
    motion = Motion("yaw")
    source, target, T = problem(bodies_numpy[0], motion.starts(0)[11])  # 165 deg
    found = search(fast, source, target, motion.starts(0), basis=motion.basis())
    up = np.array([0.0, 0.0, 1.0])
    assert np.abs(found.g[:, :3, :3] @ up - up).max() < 1e-12
    assert off(found, T) < 3
