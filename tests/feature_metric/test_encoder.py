"""The encoder F, its critical points, and its Jacobian by the chain rule through them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fmr_cli.feature_metric.encoder import Encoder, jacobian
from fmr_cli.feature_metric.solver import FINITE_STEP, finite_jacobian
from fmr_cli.geometry import se3


def test_the_paper_s_widths_and_nothing_but_linear_layers() -> None:
    encoder = Encoder()
    assert [tuple(layer.weight.shape) for layer in encoder.linear] == [
        (64, 3), (64, 64), (64, 64), (128, 64), (1024, 128),
    ]  # fmt: skip
    assert {name.split(".")[-1] for name in encoder.state_dict()} == {"weight", "bias"}


def test_the_feature_dimension_is_a_parameter() -> None:
    assert Encoder(feature_dim=40)(torch.randn(2, 9, 3)).shape == (2, 40)


def test_the_order_of_the_points_does_not_matter(encoder: Encoder, bodies: Tensor) -> None:
    torch.testing.assert_close(encoder(bodies.flip(1)), encoder(bodies), rtol=0, atol=1e-6)


@pytest.mark.parametrize("chunk", [1, 100, 1024, 5000])
def test_chunks_give_the_plain_maximum(encoder: Encoder, bodies: Tensor, chunk: int) -> None:
    points = bodies[:2, :300] if chunk == 1 else bodies[:2]
    plain = encoder.pointwise(points).amax(1)
    torch.testing.assert_close(encoder(points, chunk), plain, rtol=0, atol=1e-6)
    feature, index = encoder.encode(points, chunk)
    torch.testing.assert_close(feature, plain, rtol=0, atol=1e-6)
    at_critical = encoder.pointwise(points).gather(1, index[:, None])[:, 0]
    torch.testing.assert_close(at_critical, plain, rtol=0, atol=1e-6)


def test_the_jacobian_is_that_of_autograd(exact_encoder: Encoder, bodies: Tensor) -> None:
    points = bodies[:3, :256].double()
    _, index = exact_encoder.encode(points)

    J = jacobian(exact_encoder, points, index)
    xi = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    moved = exact_encoder(se3.transform(se3.exp(-xi), points))
    weights = torch.randn(5, *moved.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for weight in [*weights, torch.eye(1024, dtype=torch.float64)[7].expand_as(moved)]:
        (by_autograd,) = torch.autograd.grad(moved, xi, weight, retain_graph=True)
        torch.testing.assert_close((weight[:, None] @ J)[:, 0], by_autograd, rtol=0, atol=1e-12)


def test_finite_differences_tend_to_the_jacobian(exact_encoder: Encoder, bodies: Tensor) -> None:
    points = bodies[:3, :256].double()
    feature, index = exact_encoder.encode(points)
    exact = jacobian(exact_encoder, points, index)
    off = [
        float((finite_jacobian(exact_encoder, points, feature, step) - exact).norm() / exact.norm())
        for step in (FINITE_STEP, FINITE_STEP / 10, FINITE_STEP / 100, FINITE_STEP / 1e5)
    ]
    assert off[0] < 0.25  # over the paper's step other points take channels over
    assert off[1] < off[0] / 2
    assert off[2] < off[1] / 2
    assert off[3] < 1e-5
