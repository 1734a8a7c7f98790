"""The pose graph: exact where links are, robust where one is wrong, honest about what the others say of a link."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.motion import Motion, exp
from fmr_cli.multiway.pose_graph import (
    Factor,
    Prior,
    bounded,
    covariance_of,
    in_order,
    optimise,
    prior_factor,
)

SIGMA = np.array([1e-3] * 3 + [1e-2] * 3)


def world(count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-5, 5, 3)
        poses.append(T)
    return poses


def factor(poses, i, j, twist=(0,) * 6) -> Factor:
    T = exp(np.array(twist, float)) @ np.linalg.inv(poses[j]) @ poses[i]
    return Factor(i, j, T, np.diag(1 / SIGMA**2))


def test_it_finds_exact_poses_from_rough_ones():
    poses = world(5)
    factors = [factor(poses, i, j) for i, j in ((1, 0), (2, 1), (3, 2), (4, 3), (4, 0))]
    rough = {n: T @ exp(np.full(6, 0.05 * (n > 0))) for n, T in enumerate(poses)}
    found = optimise(rough, factors, [], {0}, Motion(), 0.05)
    for n, T in enumerate(poses):
        assert np.allclose(found.T_component_scan[n], T, atol=1e-5)


def test_the_covariance_is_that_of_many_draws():
    rng, poses, draws = np.random.default_rng(1), world(3), []
    for _ in range(200):
        noisy = [factor(poses, i, j, rng.normal(size=6) * SIGMA) for i, j in ((1, 0), (2, 1), (2, 0))]
        found = optimise(dict(enumerate(poses)), noisy, [], {0}, Motion(), 0.05, robust=False)
        D = np.linalg.inv(poses[2]) @ found.T_component_scan[2]
        draws.append(D[:3, 3])
    expected = np.sqrt(np.trace(found.covariance[2][3:, 3:]))
    assert np.sqrt(np.trace(np.cov(np.array(draws).T))) == pytest.approx(expected, rel=0.15)


def test_what_the_others_say_of_a_link_is_what_they_say_without_it():
    poses = world(4)
    off = np.array([0.0, 0, 0, 0.02, -0.01, 0.01])
    ends = ((1, 0), (2, 1), (3, 2), (3, 0), (2, 0))
    factors = [factor(poses, *e, off if k == 4 else (0,) * 6) for k, e in enumerate(ends)]
    found = optimise(dict(enumerate(poses)), factors, [], {0}, Motion(), 0.05)
    assert np.allclose(found.apart[4], np.linalg.inv(poses[0]) @ poses[2], atol=2e-3)
    alone = optimise(dict(enumerate(poses)), factors[:3], [], {0}, Motion(), 0.05)
    assert alone.apart == [None, None, None], "no cycle, nothing to say"


def test_a_gross_error_hardly_moves_the_others():
    poses = world(4)
    ends = ((1, 0), (2, 1), (3, 2), (3, 0), (3, 1))
    factors = [factor(poses, *e) for e in ends] + [factor(poses, 2, 0, [0.4, 0, 0, 1.0, 0, 0])]
    found = optimise(dict(enumerate(poses)), factors, [], {0}, Motion(), 0.05)
    for n, T in enumerate(poses):
        assert np.linalg.norm((found.T_component_scan[n] - T)[:3, 3]) < 0.01


def test_a_prior_fixes_the_frame():
    poses = world(3)
    factors = [factor(poses, 1, 0), factor(poses, 2, 1)]
    shifted = {n: exp(np.array([0, 0, 0.1, 1, 0, 0])) @ T for n, T in enumerate(poses)}
    found = optimise(shifted, factors, [Prior(0, poses[0], 0.01, 0.1)], set(), Motion(), 0.05)
    for n, T in enumerate(poses):
        assert np.allclose(found.T_component_scan[n], T, atol=1e-4)


def test_levelled_scans_stay_level():
    turn = [Rotation.from_euler("z", a).as_matrix() for a in (0, 0.5, 1.0)]
    poses = [np.block([[R, np.array([[k], [0], [0]])], [np.zeros((1, 3)), 1]]) for k, R in enumerate(turn)]
    tilted = [factor(poses, 1, 0, [0.01, 0, 0, 0, 0, 0]), factor(poses, 2, 1), factor(poses, 2, 0)]
    found = optimise(dict(enumerate(poses)), tilted, [], {0}, Motion("yaw"), 0.05)
    assert max(abs(T[2, 2] - 1) for T in found.T_component_scan.values()) < 1e-7


def test_no_link_is_surer_than_its_grid_and_none_is_without_any():
    wide = bounded(np.zeros((6, 6)), 2.0, 0.1)
    narrow = bounded(1e30 * np.eye(6), 2.0, 0.1)
    assert np.sqrt(1 / wide[3, 3]) == pytest.approx(1.0)
    assert np.sqrt(1 / narrow[3, 3]) == pytest.approx(0.002)
    assert np.sqrt(1 / narrow[0, 0]) == pytest.approx(0.001)


def test_dense_marginals_are_those_of_gtsam():
    gtsam = pytest.importorskip("gtsam")
    T = np.eye(4)
    T[:3, 3] = [1, 2, 3]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(prior_factor(0, np.eye(4), 1e6 * np.eye(6)))
    noise = gtsam.noiseModel.Gaussian.Information(np.diag([1.0, 2, 3, 4, 5, 6]))
    graph.add(gtsam.BetweenFactorPose3(0, 5, gtsam.Pose3(T), noise))
    values.insert(0, gtsam.Pose3(np.eye(4)))
    values.insert(5, gtsam.Pose3(T))
    ours = covariance_of(graph.linearize(values).hessian(in_order([0, 5]))[0])
    theirs = gtsam.Marginals(graph, values)
    assert ours[6:, 6:] == pytest.approx(theirs.marginalCovariance(5), abs=1e-9)
    joint = theirs.jointMarginalCovariance(gtsam.KeyVector([0, 5]))
    assert ours[:6, 6:] == pytest.approx(joint.at(0, 5), abs=1e-12)


def test_a_direction_that_nothing_determines_has_a_huge_variance_beside_others_that_keep_theirs():
    H = np.diag([1e18, 4.0, 1e-6, 0.0])
    H[1, 1] += 1e-12
    covariance = covariance_of(H)
    assert np.diag(covariance)[:3] == pytest.approx([1e-18, 0.25, 1e6], rel=1e-6)
    assert covariance[3, 3] > 1e12


def test_a_chain_of_links_that_lost_their_weight_has_an_answer():
    poses = world(4)
    factors = [
        factor(poses, 1, 0),
        factor(poses, 2, 1),
        Factor(3, 2, factor(poses, 3, 2).T_target_source, np.zeros((6, 6))),
    ]
    found = optimise(dict(enumerate(poses)), factors, [], {0}, Motion(), 0.05)
    assert np.isfinite(found.T_component_scan[3]).all()
    assert np.sqrt(np.trace(found.covariance[2][3:, 3:])) < 0.2
