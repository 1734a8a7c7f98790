"""Poses from matched features, most of which are wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from fmr_cli.feature_metric import se3
from fmr_cli.feature_metric.consensus import consensus, match
from fmr_cli.feature_metric.motion import Motion, rotation_between

TOLERANCE = 0.1


def matches(outliers: float, T: Tensor, count: int = 300) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    source = 4 * torch.rand(count, 3, generator=generator)
    target = se3.transform(T, source) + 0.02 * torch.randn(count, 3, generator=generator)
    wrong = int(outliers * count)
    target[:wrong] = se3.transform(T, 4 * torch.rand(wrong, 3, generator=generator))
    return source, target


def pose(omega: tuple[float, float, float]) -> Tensor:
    return se3.exp(torch.tensor([*omega, 1.0, -2.0, 0.5]))


def test_the_pose_is_found_among_80_percent_of_wrong_matches() -> None:
    T = pose((1.0, -2.0, 0.4))
    found, inliers = consensus(*matches(0.8, T), TOLERANCE, 5, Motion())
    assert rotation_between(found[0, :3, :3], T[:3, :3]) < 0.02
    assert (found[0, :3, 3] - T[:3, 3]).norm() < 0.05
    assert 55 <= inliers[0] <= 70
    assert (inliers.diff() <= 0).all()


def test_poses_are_distinct() -> None:
    T = pose((0.0, 0.0, 0.3))
    found, _ = consensus(*matches(0.0, T), TOLERANCE, 5, Motion())
    assert len(found) == 1  # all seeds lead to the same one


def test_two_motions_give_two_poses() -> None:
    a, b = pose((1.0, 0.0, 0.0)), pose((0.0, 2.0, 0.0))
    x, y = matches(0.0, a, 40)
    u, v = matches(0.0, b, 15)
    found, inliers = consensus(torch.cat([x, u]), torch.cat([y, v]), TOLERANCE, 5, Motion())
    assert rotation_between(found[0, :3, :3], a[:3, :3]) < 0.02
    assert rotation_between(found[1, :3, :3], b[:3, :3]) < 0.02
    assert inliers[:2].tolist() == [40, 15]


def test_a_constraint_holds_in_every_pose() -> None:
    up = torch.tensor([0.0, 0.0, 1.0])
    found, _ = consensus(*matches(0.8, pose((0.0, 0.0, 2.5))), TOLERANCE, 5, Motion("yaw"))
    assert rotation_between(found[0, :3, :3], pose((0.0, 0.0, 2.5))[:3, :3]) < 0.02
    assert (found[:, :3, :3] @ up == up).all()


def test_fewer_than_three_matches_give_no_pose() -> None:
    found, inliers = consensus(torch.rand(2, 3), torch.rand(2, 3), TOLERANCE, 5, Motion())
    assert found.shape == (0, 4, 4)
    assert inliers.shape == (0,)


def test_descriptors_are_matched_both_ways_without_repetition() -> None:
    a = torch.nn.functional.normalize(torch.randn(20, 8, generator=torch.Generator().manual_seed(3)), dim=1)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(4))
    pairs = match(a, a[order])
    assert pairs.tolist() == [[i, int((order == i).nonzero())] for i in range(20)]
    assert {int(i) for i in match(a, a[:4])[:, 0]} == set(range(20))  # a point with no twin still has a nearest one
