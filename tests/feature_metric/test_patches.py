"""Patch by patch: the Jacobian of every ball, and a refinement that part overlap does not mislead."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fmr_cli.cloud import transform_points
from fmr_cli.feature_metric.layers import Layers
from fmr_cli.feature_metric.patches import Neighbourhoods, patch_features, patch_template, refine
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.pose_error import angle_between
from fmr_cli.geometry.se3 import exp
from fmr_cli.registration.models import solver
from fmr_cli.synthetic.shapes import shapes

RADIUS = 0.25


def balls(points: np.ndarray, radius: float = RADIUS) -> Neighbourhoods:
    """Every point as a neighbour of every centre, those outside the ball not valid."""

    def look(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = (points - centres[:, None]) / radius
        valid = (np.linalg.norm(offsets, axis=-1) < 1).astype(points.dtype)
        return offsets * valid[..., None], valid

    return look


@pytest.fixture(scope="module")
def layers() -> Layers:
    return solver().layers


@pytest.fixture(scope="module")
def body() -> np.ndarray:
    return shapes(1, 1200, seed=40_000)[0]


@pytest.fixture(scope="module")
def centres(body: np.ndarray) -> np.ndarray:
    return body[np.random.default_rng(0).permutation(len(body))[:48]]


def motion(degrees: float, shift: float) -> np.ndarray:
    return exp(np.array([0.6, 0.0, 0.8, 0.0, 1.0, 0.0]) * ([math.radians(degrees)] * 3 + [shift] * 3))


def moved_away(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The source that T brings onto points."""
    return transform_points(np.linalg.inv(T), points).astype(points.dtype)


def test_the_jacobian_is_that_of_central_differences(layers: Layers, body: np.ndarray, centres: np.ndarray) -> None:
    exact = [(weight.astype(float), bias.astype(float)) for weight, bias in layers]
    points, centres = body.astype(float), centres[:12].astype(float)
    template = patch_template(exact, centres, balls(points), RADIUS)
    step = 1e-6
    for axis in range(6):
        xi = step * np.eye(6)[axis]
        ahead, behind = (patch_features(exact, *balls(transform_points(exp(x), points))(centres)) for x in (-xi, xi))
        close = np.isclose((ahead - behind) / (2 * step), template.J[..., axis], rtol=1e-4, atol=1e-4)
        assert close.mean() > 0.995  # all but where a unit switches on within the step
    np.testing.assert_allclose(template.JtJ, np.swapaxes(template.J, 1, 2) @ template.J)


def test_a_point_on_the_border_enters_without_a_jump(layers: Layers) -> None:
    inside, outside = (
        patch_features(layers, *balls(np.array([[0.1, 0, 0], [x * RADIUS, 0, 0]], np.float32))(np.zeros((1, 3))))
        for x in (1 - 1e-4, 1 + 1e-4)
    )
    assert np.abs(inside - outside).max() < 1e-3


def test_a_motion_is_undone(layers: Layers, body: np.ndarray, centres: np.ndarray) -> None:
    T = motion(8, 0.04)
    template = patch_template(layers, centres, balls(body), RADIUS)
    fit = refine(layers, template, balls(moved_away(T, body)), np.eye(4), 15)
    assert math.degrees(angle_between(fit.g[:3, :3], T[:3, :3])) < 0.05
    assert np.linalg.norm(fit.g[:3, 3] - T[:3, 3]) < 1e-3
    assert np.nanmedian(fit.error) < 1e-3 * np.linalg.norm(template.feature, axis=1).mean()


def test_patches_without_a_counterpart_drop_out(layers: Layers, body: np.ndarray, centres: np.ndarray) -> None:
    T = motion(8, 0.04)
    half = body[body[:, 0] < np.median(body[:, 0])]
    template = patch_template(layers, centres, balls(body), RADIUS)
    fit = refine(layers, template, balls(moved_away(T, half)), np.eye(4), 15)
    assert math.degrees(angle_between(fit.g[:3, :3], T[:3, :3])) < 0.5
    gone = centres[:, 0] > half[:, 0].max() + RADIUS
    assert gone.any()
    assert np.isnan(fit.error[gone]).all()
    assert (fit.weight[gone] == 0).all()


def test_nothing_in_common_leaves_the_pose_and_says_so(layers: Layers, body: np.ndarray, centres: np.ndarray) -> None:
    template = patch_template(layers, centres, balls(body), RADIUS)
    g = motion(5, 0.0)
    fit = refine(layers, template, balls(body + 100), g, 5)
    assert (fit.g == g).all()
    assert np.isnan(fit.error).all()


def test_a_constraint_holds_exactly(layers: Layers, body: np.ndarray, centres: np.ndarray) -> None:
    source = moved_away(motion(8, 0.04), body)
    template = patch_template(layers, centres, balls(body), RADIUS)
    planar = refine(layers, template, balls(source), np.eye(4), 5, Motion("planar").basis()).g
    assert planar[2].tolist() == [0, 0, 1, 0]
    moved = refine(layers, template, balls(source), np.eye(4), 5, Motion("translation").basis()).g
    assert (moved[:3, :3] == np.eye(3)).all()


def test_both_jacobians_undo_a_motion_too_and_come_nearer_by_one_step(
    layers: Layers, body: np.ndarray, centres: np.ndarray
) -> None:
    template = patch_template(layers, centres[::2], balls(body), RADIUS)
    off = {False: [], True: []}
    for degrees in (2, 4, 8):
        T = motion(degrees, 0.01)
        look = balls(moved_away(T, body))
        for both, found in off.items():
            fit = refine(layers, template, look, np.eye(4), 1, both=both)
            found.append(math.degrees(angle_between(fit.g[:3, :3], T[:3, :3])))
        fit = refine(layers, template, look, np.eye(4), 15, both=True)
        assert math.degrees(angle_between(fit.g[:3, :3], T[:3, :3])) < 0.05
    assert sum(off[True]) < sum(off[False])  # to second order
