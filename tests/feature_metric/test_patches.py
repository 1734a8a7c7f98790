"""Patch by patch: the Jacobian of every ball, and a refinement that part overlap does not mislead."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from fmr_cli.feature_metric import se3
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.motion import Motion, rotation_between
from fmr_cli.feature_metric.patches import Neighbourhoods, patch_features, patch_template, refine
from fmr_cli.training.shapes import shapes

RADIUS = 0.25


def balls(points: Tensor, radius: float = RADIUS) -> Neighbourhoods:
    """Every point as a neighbour of every centre, those outside the ball not valid."""

    def look(centres: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        offsets = (points - centres[:, None].to(points)) / radius
        valid = (offsets.norm(dim=-1) < 1).to(points)
        return offsets * valid[..., None], valid, valid.sum(1)

    return look


@pytest.fixture(scope="module")
def body() -> Tensor:
    return torch.from_numpy(shapes(1, 1200, seed=40_000))[0]


@pytest.fixture(scope="module")
def centres(body: Tensor) -> Tensor:
    return body[torch.randperm(len(body), generator=torch.Generator().manual_seed(0))[:48]]


def motion(degrees: float, shift: float) -> Tensor:
    twist = torch.tensor([0.6, 0.0, 0.8, 0.0, 1.0, 0.0], dtype=torch.float64)
    return se3.exp(twist * torch.tensor([math.radians(degrees)] * 3 + [shift] * 3))


def test_the_jacobian_is_that_of_central_differences(exact_encoder: Encoder, body: Tensor, centres: Tensor) -> None:
    points, centres = body.double(), centres[:12].double()
    template = patch_template(exact_encoder, centres, balls(points), RADIUS)
    step = 1e-6
    for axis in range(6):
        xi = step * torch.eye(6, dtype=torch.float64)[axis]
        ahead, behind = (
            patch_features(exact_encoder, *balls(se3.transform(se3.exp(x), points))(centres)[:2])[0] for x in (-xi, xi)
        )
        column = (ahead - behind) / (2 * step)
        torch.testing.assert_close(column, template.J[..., axis], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(template.JtJ, template.J.mT @ template.J)


def test_a_point_on_the_border_enters_without_a_jump(encoder: Encoder) -> None:
    centre = torch.zeros(1, 3)
    inside, outside = (
        patch_features(encoder, *balls(torch.tensor([[0.1, 0, 0], [x * RADIUS, 0, 0]]))(centre)[:2])[0]
        for x in (1 - 1e-4, 1 + 1e-4)
    )
    assert (inside - outside).abs().max() < 1e-3


def test_a_motion_is_undone(encoder: Encoder, body: Tensor, centres: Tensor) -> None:
    T = motion(8, 0.04)
    source = se3.transform(torch.linalg.inv(T).float(), body)
    template = patch_template(encoder, centres, balls(body), RADIUS)
    fit = refine(encoder, template, balls(source), torch.eye(4, dtype=torch.float64), 15)
    assert math.degrees(rotation_between(fit.g[:3, :3], T[:3, :3])) < 0.05
    assert (fit.g[:3, 3] - T[:3, 3]).norm() < 1e-3
    assert fit.error.nanmedian() < 1e-3 * template.feature.norm(dim=1).mean()


def test_patches_without_a_counterpart_drop_out(encoder: Encoder, body: Tensor, centres: Tensor) -> None:
    T = motion(8, 0.04)
    half = body[body[:, 0] < body[:, 0].median()]
    source = se3.transform(torch.linalg.inv(T).float(), half)
    template = patch_template(encoder, centres, balls(body), RADIUS)
    fit = refine(encoder, template, balls(source), torch.eye(4, dtype=torch.float64), 15)
    assert math.degrees(rotation_between(fit.g[:3, :3], T[:3, :3])) < 0.5
    gone = centres[:, 0] > half[:, 0].max() + RADIUS
    assert gone.any()
    assert fit.error[gone].isnan().all()
    assert (fit.weight[gone] == 0).all()


def test_nothing_in_common_leaves_the_pose_and_says_so(encoder: Encoder, body: Tensor, centres: Tensor) -> None:
    template = patch_template(encoder, centres, balls(body), RADIUS)
    g = motion(5, 0.0)
    fit = refine(encoder, template, balls(body + 100), g, 5)
    assert torch.equal(fit.g, g)
    assert fit.error.isnan().all()
    assert (fit.information == 0).all()


def test_a_constraint_holds_exactly(encoder: Encoder, body: Tensor, centres: Tensor) -> None:
    source = se3.transform(torch.linalg.inv(motion(8, 0.04)).float(), body)
    template = patch_template(encoder, centres, balls(body), RADIUS)
    g = torch.eye(4, dtype=torch.float64)
    planar = refine(encoder, template, balls(source), g, 5, Motion("planar").basis()).g
    assert planar[2].tolist() == [0, 0, 1, 0]
    moved = refine(encoder, template, balls(source), g, 5, Motion("translation").basis()).g
    assert torch.equal(moved[:3, :3], torch.eye(3, dtype=torch.float64))


def test_the_information_matrix_is_symmetric_and_positive(encoder: Encoder, body: Tensor, centres: Tensor) -> None:
    template = patch_template(encoder, centres, balls(body), RADIUS)
    information = refine(encoder, template, balls(body[::2]), torch.eye(4, dtype=torch.float64), 5).information
    torch.testing.assert_close(information, information.T, rtol=1e-5, atol=0)
    assert torch.linalg.eigvalsh(information).min() > 0
