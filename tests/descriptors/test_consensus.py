"""Poses from matched features, most of which are wrong."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from fmr_cli.cloud import transform_points
from fmr_cli.descriptors.consensus import BLOCK, SEEDS, agreeing, consensus, spread_seeds, within
from fmr_cli.descriptors.matching import match
from fmr_cli.geometry.motion import Motion, moments
from fmr_cli.geometry.pose_error import angle_between
from fmr_cli.geometry.se3 import exp

TOLERANCE = 0.1


def matches(outliers: float, T: np.ndarray, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    source = 4 * rng.random((count, 3))
    target = transform_points(T, source) + 0.02 * rng.normal(size=(count, 3))
    wrong = int(outliers * count)
    target[:wrong] = transform_points(T, 4 * rng.random((wrong, 3)))
    return source, target


def pose(omega: tuple[float, float, float]) -> np.ndarray:
    return exp(np.array([*omega, 1.0, -2.0, 0.5]))


def test_the_pose_is_found_among_80_percent_of_wrong_matches() -> None:
    T = pose((1.0, -2.0, 0.4))
    found, inliers = consensus(*matches(0.8, T), TOLERANCE, 5, Motion())
    assert angle_between(found[0, :3, :3], T[:3, :3]) < 0.02
    assert np.linalg.norm(found[0, :3, 3] - T[:3, 3]) < 0.05
    assert 55 <= inliers[0] <= 70
    assert (np.diff(inliers) <= 0).all()


def test_poses_are_distinct() -> None:
    found, _ = consensus(*matches(0.0, pose((0.0, 0.0, 0.3))), TOLERANCE, 5, Motion())
    assert len(found) == 1  # all seeds lead to the same one


def test_two_motions_give_two_poses() -> None:
    a, b = pose((1.0, 0.0, 0.0)), pose((0.0, 2.0, 0.0))
    x, y = matches(0.0, a, 40)
    u, v = matches(0.0, b, 15)
    found, inliers = consensus(np.concatenate([x, u]), np.concatenate([y, v]), TOLERANCE, 5, Motion())
    assert angle_between(found[0, :3, :3], a[:3, :3]) < 0.02
    assert angle_between(found[1, :3, :3], b[:3, :3]) < 0.02
    assert inliers[:2].tolist() == [40, 15]


def test_a_constraint_holds_in_every_pose() -> None:
    found, _ = consensus(*matches(0.8, pose((0.0, 0.0, 2.5))), TOLERANCE, 5, Motion("yaw"))
    assert angle_between(found[0, :3, :3], pose((0.0, 0.0, 2.5))[:3, :3]) < 0.02
    assert (found[:, :3, 2] == [0, 0, 1]).all()


def test_fewer_than_three_matches_give_no_pose() -> None:
    found, inliers = consensus(np.ones((2, 3)), np.ones((2, 3)), TOLERANCE, 5, Motion())
    assert found.shape == (0, 4, 4)
    assert inliers.shape == (0,)


def test_descriptors_are_matched_both_ways_without_repetition() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(20, 8))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    order = rng.permutation(20)
    assert match(a, a[order]).tolist() == [[i, int(np.flatnonzero(order == i)[0])] for i in range(20)]
    assert set(match(a, a[:4])[:, 0].tolist()) == set(range(20))  # a point with no twin still has a nearest one


def test_agreement_in_blocks_is_that_of_all_at_once() -> None:
    source, target = matches(0.5, pose((1.0, -2.0, 0.4)), 3 * BLOCK + 5)
    apart = np.abs(cdist(source, source) - cdist(target, target))
    agree = agreeing(source, target, TOLERANCE)
    assert agree.dtype == np.float32
    clear = np.abs(apart - TOLERANCE) > 1e-4  # single precision decides the rest
    assert np.array_equal(agree[clear], (apart < TOLERANCE)[clear].astype(np.float32))


def test_of_one_place_there_is_one_seed() -> None:
    source, target = matches(0.3, pose((1.0, -2.0, 0.4)))
    source, target = np.concatenate([source, source + 0.03]), np.concatenate([target, target - 0.03])
    agree = agreeing(source, target, TOLERANCE)
    seeds = spread_seeds(agree, source, target, TOLERANCE, np.ones(len(source), bool))
    assert len(seeds) == SEEDS
    same = (np.abs(source[seeds, None] - source[seeds]).max(-1) < TOLERANCE) & (
        np.abs(target[seeds, None] - target[seeds]).max(-1) < TOLERANCE
    )
    assert np.array_equal(same, np.eye(SEEDS, dtype=bool))


def test_matches_within_reach_are_those_with_small_residuals() -> None:
    source, target = (x + 50.0 for x in matches(0.5, pose((1.0, -2.0, 0.4))))  # far from the origin
    T = np.stack([pose((1.0, -2.0, 0.4)), np.eye(4)])
    apart = np.linalg.norm(transform_points(T, source) - target, axis=2)
    for tolerance in (0.03, 3.0):
        assert np.array_equal(within(T, moments(source, target), tolerance), apart < tolerance)


def test_seeds_are_the_first_of_each_place_in_the_order_of_their_weight() -> None:
    source, target = matches(0.3, pose((1.0, -2.0, 0.4)), 3 * BLOCK)
    agree = agreeing(source, target, TOLERANCE)
    use = np.arange(len(source)) % 4 > 0
    seeds = spread_seeds(agree, source, target, 10 * TOLERANCE, use).tolist()
    weight = use.astype(float)
    for _ in range(4):
        weight = (agree @ weight) * use
    plain: list[int] = []
    for i in np.argsort(-weight, kind="stable")[: use.sum()]:
        near = [np.abs(x[i] - x[plain]).max(1, initial=0) < 10 * TOLERANCE for x in (source, target)]
        plain += [] if (near[0] & near[1]).any() else [int(i)]
    assert seeds == plain[:SEEDS]
