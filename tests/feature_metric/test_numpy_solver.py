"""The solver without torch says what the plain one says."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.encoder import Encoder, jacobian
from fmr_cli.feature_metric.numpy_encoder import spread
from fmr_cli.feature_metric.numpy_solver import LARGE, NumpySolver
from fmr_cli.feature_metric.solver import OnDevice
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.nearest import along_curve
from fmr_cli.geometry.se3 import exp
from fmr_cli.synthetic.shapes import shapes

START = np.eye(4)[None]


def pair(cloud: np.ndarray, kind: str, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Source and target of a cloud (N, 3): the same points, or halves drawn apart, or these with noise."""
    rng = np.random.default_rng(3)
    source = target = cloud
    if kind != "copy":
        source, target = cloud[::2], cloud[1::2]
    if kind == "noise":
        source, target = (x + rng.normal(size=x.shape) * 0.005 for x in (source, target))
    axis = rng.normal(size=3)
    T = exp(np.concatenate([np.radians(degrees) * axis / np.linalg.norm(axis), [0.03, -0.02, 0.05]]))
    return transform_points(np.linalg.inv(T), source).astype(np.float32), target.astype(np.float32)


def test_no_torch_is_imported() -> None:
    code = "import sys, fmr_cli.feature_metric.search; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_feature_and_critical_points_are_those_of_the_encoder(
    fast: NumpySolver, encoder: Encoder, room: np.ndarray
) -> None:
    feature, index = fast.encode(room)
    expected, where = encoder.encode(torch.from_numpy(room)[None])
    np.testing.assert_allclose(feature, expected[0], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(fast(room), feature)
    values = encoder.pointwise(torch.from_numpy(room[index])).diagonal()
    np.testing.assert_allclose(values, expected[0], rtol=0, atol=1e-5)  # another point only where two are equal
    assert (index == where[0].numpy()).mean() > 0.99


@pytest.mark.parametrize("cloud", ["room", "shape", "copies", "plane", "few"])
def test_only_those_that_can_win_are_multiplied_and_nothing_is_missed(
    fast: NumpySolver, room: np.ndarray, cloud: str
) -> None:
    points = {
        "room": lambda: room,
        "shape": lambda: shapes(1, 6200, seed=20_100)[0],
        "copies": lambda: np.repeat(room[:40], 160, 0),  # every point ties with 159
        "plane": lambda: room[:6200] * np.float32([1, 1, 0]),
        "few": lambda: room[:701],  # no whole number of blocks
    }[cloud]()
    points = points[along_curve(points)]
    posed = fast.posed(exp(np.array([0.3, -0.5, 0.4, 0.1, 0.0, -0.1])))
    feature = fast.peaks(points, [posed], map)[0][0]
    found, critical, rivals = fast.whole(points, posed, map)
    np.testing.assert_allclose(found, feature, rtol=0, atol=2e-6)

    every = np.concatenate(
        [fast.last_hidden(part, posed) @ posed[-1][0].T for part in np.split(points, range(256, len(points), 256))]
    )
    every += posed[-1][1]
    np.testing.assert_allclose(every[critical, np.arange(1024)], feature, rtol=0, atol=2e-6)
    again, _, near = fast.contest(points, posed, found, critical, 5e-3, map)
    np.testing.assert_allclose(again, feature, rtol=0, atol=2e-6)
    paired = np.zeros(every.shape, bool)
    for part in near:
        np.testing.assert_array_equal(points[part.index], part.points)
        pairs = np.ix_(part.index, part.channels)
        paired[pairs] = True
        reaching = every[pairs] > feature[part.channels] - 5e-3 - 4e-6
        assert reaching.any(0).all()
        assert reaching.any(1).all()
    assert paired[every > feature - 5e-3 + 4e-6].all()
    for alone, of in (fast.among(x, posed, map) for x in (rivals, near)):
        np.testing.assert_allclose(alone, feature, rtol=0, atol=2e-6)
        np.testing.assert_allclose(every[of, np.arange(1024)], feature, rtol=0, atol=2e-6)


def test_the_jacobian_is_the_exact_one(fast: NumpySolver, encoder: Encoder, room: np.ndarray) -> None:
    _, index = fast.encode(room)
    expected = jacobian(encoder, torch.from_numpy(room)[None], torch.from_numpy(index)[None])[0]
    np.testing.assert_allclose(fast.template(room).J, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("kind", ["copy", "resample", "noise"])
@pytest.mark.parametrize("degrees", [pytest.param(5, marks=pytest.mark.slow), 50])
def test_the_pose_of_the_plain_solver(
    fast: NumpySolver, encoder: Encoder, room: np.ndarray, kind: str, degrees: float, robust: bool
) -> None:
    source, target = pair(room[:3000], kind, degrees)
    plain = OnDevice(encoder)
    expected = plain.solve(plain.template(target), source, START, 10, robust)
    found = fast.solve(fast.template(target), source, START, 10, robust)
    np.testing.assert_allclose(found.g, expected.g, rtol=0, atol=2e-5)
    both = min(len(found.errors), len(expected.errors))  # the end of a copy may come an iteration sooner or later
    np.testing.assert_allclose(found.errors[:both], expected.errors[:both], rtol=0, atol=1e-5)


@pytest.mark.parametrize(("kind", "robust"), [
    ("copy", False), ("resample", True), ("noise", True),
    pytest.param("copy", True, marks=pytest.mark.slow), pytest.param("resample", False, marks=pytest.mark.slow),
    pytest.param("noise", False, marks=pytest.mark.slow),
])  # fmt: skip
def test_few_of_many_points_lead_to_the_pose_of_all(
    fast: NumpySolver, encoder: Encoder, room: np.ndarray, kind: str, robust: bool
) -> None:
    source, target = pair(room, kind, 40)
    assert len(source) >= LARGE
    plain = OnDevice(encoder)
    expected = plain.solve(plain.template(target), source, START, 15, robust)
    found = fast.solve(fast.template(target), source, START, 15, robust)
    np.testing.assert_allclose(found.g, expected.g, rtol=0, atol=1e-6 if kind == "copy" else 1e-3 if robust else 1e-4)
    moved = transform_points(found.g[0], source).astype(np.float32)
    everything = np.abs(fast(moved) - fast(target)).mean()
    np.testing.assert_allclose(found.error, everything, rtol=0, atol=1e-6)  # the last error is that of all points


def test_threads_change_no_bit(fast: NumpySolver, room: np.ndarray) -> None:
    source, target = pair(room, "resample", 30)
    one, two = (fast.solve(fast.template(target, n), source, START, threads=n) for n in (1, 2))
    assert (one.g == two.g).all()
    assert (one.errors == two.errors).all()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_work_is_spread_in_order_and_its_failures_show(threads: int) -> None:
    def divided(a: int, b: int) -> float:
        time.sleep(0.05 * (a == 0))  # the others are done before the first
        return a / b

    with spread(threads) as run:
        assert list(run(divided, range(20), range(1, 21))) == [a / (a + 1) for a in range(20)]
        with pytest.raises(ZeroDivisionError):
            list(run(divided, [1] * 5, [3, 2, 1, 0, 0]))


def test_constrained_and_many_starts(fast: NumpySolver, encoder: Encoder, room: np.ndarray) -> None:
    motion, plain = Motion("yaw"), OnDevice(encoder)
    starts = motion.starts(0)[:5]
    target, source = room[:256], room[256:512]
    found = fast.solve(fast.template(target), source, starts, 6, True, motion.basis())
    expected = plain.solve(plain.template(target), source, starts, 6, True, motion.basis())
    np.testing.assert_allclose(found.g, expected.g, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(found.g[:, 2, :3], np.tile([0.0, 0.0, 1.0], (5, 1)))


def test_what_a_point_or_a_line_does_not_determine_shows_in_the_rank_and_stays(fast: NumpySolver) -> None:
    point = np.full((100, 3), 0.3, np.float32)
    line = (np.linspace(-0.5, 0.5, 100)[:, None] * [0.6, 0.0, 0.8] + [0.0, 0.1, 0.0]).astype(np.float32)
    for target, rank in ((point, 3), (line, 5)):
        found = fast.solve(fast.template(target), target + np.float32(0.01), START)
        assert found.rank == rank
        np.testing.assert_allclose(transform_points(found.g[0], target + 0.01), target, rtol=0, atol=1e-4)
        np.testing.assert_allclose(found.g[0, :3, :3], np.eye(3), rtol=0, atol=0.01)
