"""The search over starts: any rotation, full overlap."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from fmr_cli.feature_metric import se3
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.motion import Motion, rotation_between, rotations
from fmr_cli.feature_metric.search import APART, KEPT, STARTS, Found, search


@pytest.fixture(scope="module")
def turned(bodies: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Per shape: source, target, drawn apart, and the rotation between them, from anywhere in SO(3)."""
    found = []
    for i, T in enumerate(rotations(300)[[11, 97]].float()):
        found.append((se3.transform(T.mT, bodies[i : i + 1, 512:896]), bodies[i : i + 1, :384], T))
    return found


@pytest.fixture(scope="module")
def results(encoder: Encoder, turned: list[tuple[Tensor, Tensor, Tensor]]) -> list[Found]:
    return [search(encoder, source, target, rotations(STARTS)) for source, target, _ in turned]


def test_any_rotation_is_found(results: list[Found], turned: list[tuple[Tensor, Tensor, Tensor]]) -> None:
    for found, (_, _, T) in zip(results, turned, strict=True):
        assert math.degrees(rotation_between(found.g[0, :3, :3].double(), T[:3, :3].double())) < 3


def test_other_poses_are_distinct_and_worse(results: list[Found]) -> None:
    for found in results:
        assert 1 <= len(found.g) <= KEPT
        assert (found.error.diff() >= 0).all()
        assert found.errors.shape[1] == len(found.g)
        torch.testing.assert_close(found.errors[-1], found.error)
        for i in range(len(found.g)):
            for j in range(i):
                assert rotation_between(found.g[i, :3, :3], found.g[j, :3, :3]) > APART


def test_the_same_poses_every_run(
    encoder: Encoder, turned: list[tuple[Tensor, Tensor, Tensor]], results: list[Found]
) -> None:
    source, target, _ = turned[0]
    assert torch.equal(search(encoder, source, target, rotations(STARTS)).g, results[0].g)


def test_a_search_about_the_vertical_keeps_it(encoder: Encoder, bodies: Tensor) -> None:
    motion = Motion("yaw")
    T = motion.starts(0)[11].float()  # 165 deg
    source = se3.transform(T.mT, bodies[:1, 512:896])
    found = search(encoder, source, bodies[:1, :384], motion.starts(0), basis=motion.basis())
    up = torch.tensor([0.0, 0.0, 1.0])
    assert (found.g[:, :3, :3] @ up - up).abs().max() < 1e-6
    assert math.degrees(rotation_between(found.g[0, :3, :3], T[:3, :3])) < 3
