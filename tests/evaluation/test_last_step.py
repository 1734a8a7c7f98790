"""Last steps compared: the limit is reached by who knows normals and partners, and every step is judged alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmr_cli.cli.evaluate import chosen_experiments
from fmr_cli.errors import FmrError
from fmr_cli.evaluation import last_step
from fmr_cli.evaluation.catalogue import EXPERIMENTS
from fmr_cli.evaluation.cramer_rao import information, median_rotation
from fmr_cli.evaluation.experiments import Clouds
from fmr_cli.geometry.se3 import exp, log
from fmr_cli.synthetic.near_pairs import Degraded, TwoSamples, near_pair
from fmr_cli.synthetic.shapes import others


def body(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on a box of half extents 1, 2, 3, and their normals."""
    half = np.array([1.0, 2.0, 3.0])
    points, normals = rng.uniform(-1, 1, (count, 3)) * half, np.zeros((count, 3))
    rows, axis, side = np.arange(count), rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points[rows, axis], normals[rows, axis] = side * half[axis], side
    return points, normals


@pytest.mark.parametrize("more", [1, 3])
def test_the_limit_is_what_the_best_estimate_reaches(more: int) -> None:
    """Least squares on the planes through the means of ``more`` noisy points of the target a point of the source."""
    rng, sigma = np.random.default_rng(more), 0.02
    points, normals = body(rng, 500)
    limit = median_rotation(information(points, normals, sigma**2 + sigma**2 / more))
    middle, found = points.mean(0), []
    for _ in range(400):
        x = points + rng.normal(0, sigma, points.shape)
        y = points + rng.normal(0, sigma, (more, *points.shape)).mean(0)
        J = np.hstack([np.cross(points - middle, normals), normals])
        step = np.linalg.lstsq(J, ((y - x) * normals).sum(1), rcond=None)[0]
        found.append(np.degrees(np.linalg.norm(step[:3])))
    assert np.median(found) == pytest.approx(limit, rel=0.08)  # a median of 400 is true to 4 %


def test_the_limit_falls_with_the_root_of_the_points_and_rises_with_the_noise() -> None:
    rng = np.random.default_rng(0)
    few, many = (median_rotation(information(*body(rng, count), 1e-4)) for count in (2000, 32_000))
    assert few / many == pytest.approx(4, rel=0.1)
    points, normals = body(rng, 2000)
    assert median_rotation(information(points, normals, 4e-4)) == pytest.approx(
        2 * median_rotation(information(points, normals, 1e-4))
    )


def test_the_error_is_about_the_middle_and_in_sizes() -> None:
    truth, middle = exp(np.array([0.3, -0.2, 0.9, 5.0, 6.0, 7.0])), np.array([10.0, 0, 0])
    about = np.eye(4)
    about[:3, 3] = middle
    off = about @ exp(np.array([0, 0, np.radians(2), 0, 0.5, 0])) @ np.linalg.inv(about)
    degrees, shift, rmse = last_step.normalised_error(off @ truth, truth, middle, 5.0)
    assert degrees == pytest.approx(2)
    twist = log(exp(np.array([0, 0, np.radians(2), 0, 0.5, 0])))
    assert shift == pytest.approx(0.1, rel=1e-3)
    assert rmse == pytest.approx(np.sqrt((np.append(twist[:3], twist[3:] / 5.0) ** 2).mean()), rel=1e-6)


def test_pairs_whose_pose_nothing_tells_are_no_test() -> None:
    points, normals = body(np.random.default_rng(0), 2000)
    assert TwoSamples(points, points, normals).determined
    top = normals[:, 2] > 0
    assert not TwoSamples(points[top], points[top], normals[top]).determined, "a plane"
    assert not TwoSamples(points + 100, points, normals).determined, "nothing in common"


def test_every_step_comes_nearer_on_clean_scans() -> None:
    cloud = others(6, 4000, seed=3)[5].astype(float)
    clouds = Clouds("room", torch.from_numpy(cloud[None].astype(np.float32)), [])
    rng = np.random.default_rng((0, 0))
    near = near_pair(
        last_step.samples(clouds, "refine-density", 2000, rng), Degraded(), np.random.default_rng((0, 0, 0))
    )
    begun = last_step.normalised_error(near.start, near.T_target_source, near.target.mean(0), near.size)
    rows = last_step.at_level(EXPERIMENTS["refine-density"], 0, clouds, 1, 2000, 0)
    assert [row.method for row in rows] == list(last_step.STEPS)
    for row in rows:
        assert (row.experiment, row.clouds, row.level, row.pairs) == ("refine-density", "room", 1.0, 1)
        patches_last = row.method.split(", ")[-1] in ("patches", "both J")  # by the cloud, they leave 0.1 to 0.6 of it
        assert row.rotation_median < (0.7 if patches_last else 0.1) * begun[0]
        assert row.limit_median == 0
        assert row.limit_ratio is None


def test_with_noise_the_errors_stand_beside_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(last_step, "STEPS", {"fmr align": last_step.by_default, "nothing": lambda pair, T: T})
    one, other = last_step.at_level(EXPERIMENTS["refine-noise"], 2, None, 2, 1500, 1)
    assert 0 < one.limit_median == other.limit_median
    assert 0.2 < one.limit_ratio < other.limit_ratio  # a step is better than none
    again = last_step.at_level(EXPERIMENTS["refine-noise"], 2, None, 2, 1500, 1)[0]
    assert (one.rotation_median, one.limit_ratio) == (again.rotation_median, again.limit_ratio)


def test_refine_stands_for_all_of_its_group() -> None:
    names = chosen_experiments("refine, noise")
    assert names == ["refine-noise", "refine-density", "refine-outliers", "refine-sensors", "noise"]
    with pytest.raises(FmrError, match=r"choose from rotation, .*features, refine, refine-noise, .*cross-source"):
        chosen_experiments("refined")
