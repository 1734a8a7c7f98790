"""Points that two scans have in common fix a pose; what only lies near each other does not."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.counterparts import SOURCE, counterparts, in_strips
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.se3 import exp
from fmr_cli.synthetic.shapes import shapes

SPACING, REACH = 0.004, 1.0  # about those of the body below
TRUE = exp(np.array([0.5, -0.8, 0.3, 0.2, 0.1, -0.4]))
OFF = exp(np.array([2e-4, -1e-4, 2e-4, 8e-4, -6e-4, 4e-4]))  # a third of the spacing


@pytest.fixture(scope="module")
def body() -> np.ndarray:
    return 2.0 * shapes(1, 60_000, 3)[0].astype(float)


def found(source: np.ndarray, target: np.ndarray) -> np.ndarray | None:
    common = counterparts(source, transform_points(TRUE, target), OFF @ TRUE, SPACING, REACH, 0)
    return None if common is None else common.T_target_source


@pytest.mark.parametrize(
    ("of_source", "of_target"),
    [(slice(None), slice(None)), (slice(0, 6000), slice(None)), (slice(0, 45_000), slice(15_000, None))],
    ids=["copies", "a tenth", "two thirds"],
)
def test_the_pose_of_points_in_common_is_exact(body: np.ndarray, of_source: slice, of_target: slice) -> None:
    T = found(body[of_source], body[of_target])
    assert T is not None
    degrees, shift = pose_error(T, TRUE)
    assert degrees < 1e-10
    assert shift < 1e-12


def test_rounded_coordinates_still_tell_it(body: np.ndarray) -> None:
    step = SPACING / 10
    T = found(body, np.round(body / step) * step)
    assert T is not None
    degrees, shift = pose_error(T, TRUE)
    assert degrees < 0.002
    assert shift < step / 20  # by the mean of many


def test_two_samples_of_one_surface_have_no_points_in_common(body: np.ndarray) -> None:
    assert found(body[::2], body[1::2]) is None


def test_two_measurements_of_the_same_places_are_none(body: np.ndarray) -> None:
    """As by a scanner that stands where it stood: their rays meet the same places, each with its own noise."""
    assert found(body, body + np.random.default_rng(0).normal(0, SPACING / 8, body.shape)) is None


def test_what_is_near_the_sources_strips_lies_in_the_targets(body: np.ndarray) -> None:
    margin = 0.02
    x, y = in_strips(body, transform_points(TRUE, body), TRUE, 0.5, 0.3, margin)
    assert len(y) == pytest.approx(0.3 * len(body), rel=0.2)
    assert len(x) == pytest.approx((0.3 - 2 * margin / 0.5) * len(body), rel=0.2)
    inside = {tuple(p) for p in np.round(transform_points(np.linalg.inv(TRUE), y), 9)}
    beside = body[np.linalg.norm(body - x[0], axis=1) < margin]
    assert len(beside) > 1
    assert all(tuple(p) in inside for p in np.round(beside, 9))


def test_each_counterpart_is_observed_along_three_axes(body: np.ndarray) -> None:
    common = counterparts(body, transform_points(TRUE, body), OFF @ TRUE, SPACING, REACH, 0)
    assert common is not None
    seen = common.observed()
    assert len(common.source) <= SOURCE
    assert len(seen.x) == 3 * len(common.source)
    np.testing.assert_allclose(seen.x, seen.y, atol=1e-12)
    np.testing.assert_array_equal(seen.normal.reshape(3, -1, 3).sum(0), np.ones((len(common.source), 3)))
