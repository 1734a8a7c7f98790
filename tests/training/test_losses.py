"""The losses: right at the truth, wrong elsewhere, and their gradients reach the encoder."""

from __future__ import annotations

import pytest
import torch

from fmr_cli.feature_metric.decoder import Decoder, chamfer
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.encoder import jacobian as exact_jacobian
from fmr_cli.synthetic.batches import Augment, draw_pairs
from fmr_cli.synthetic.shapes import shapes
from fmr_cli.training.losses import (
    anchor_loss,
    critical_index,
    draw_anchors,
    encode,
    jacobian,
    pose_loss,
)


@pytest.fixture(scope="module")
def clouds():
    return torch.from_numpy(shapes(6, 256, seed=1))


@pytest.fixture(scope="module")
def encoder():
    torch.manual_seed(0)
    return Encoder(64, (32, 32))


def generator():
    return torch.Generator().manual_seed(0)


def test_chamfer_is_the_mean_squared_distance_to_the_nearest_both_ways():
    a, b = torch.tensor([[[0.0, 0, 0], [1, 0, 0]]]), torch.tensor([[[0.0, 0, 0], [0, 2, 0], [0, 3, 0]]])
    assert float(chamfer(a, b)) == pytest.approx((0 + 1) / 2 + (0 + 4 + 9) / 3)


def test_chamfer_has_the_gradient_of_the_plain_formula(clouds):
    a, b = clouds[:2, :50].clone().requires_grad_(), clouds[2:4, :60]
    distance = torch.cdist(a, b).square()
    plain = (distance.amin(2).mean(1) + distance.amin(1).mean(1)).sum()
    (expected,) = torch.autograd.grad(plain, a)
    (got,) = torch.autograd.grad(chamfer(a, b).sum(), a)
    assert torch.allclose(got, expected, atol=1e-5)


def test_the_training_feature_is_the_encoders(encoder, clouds):
    # The critical points are picked in bfloat16: another point may be taken, of nearly the same value.
    assert torch.allclose(encode(encoder, clouds).feature, encoder(clouds), atol=0.02)


def test_the_training_jacobian_is_the_exact_one_of_its_critical_points(encoder, clouds):
    expected = exact_jacobian(encoder, clouds, critical_index(encoder, clouds))
    assert torch.allclose(jacobian(encoder, encode(encoder, clouds)), expected, atol=1e-5)


def test_the_chamfer_loss_reaches_encoder_and_decoder(encoder, clouds):
    decoder = Decoder(64, 128, (32, 32, 32))
    chamfer(decoder(encode(encoder, clouds[:, :128]).feature), clouds[:, 128:]).mean().backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in [*encoder.parameters(), *decoder.parameters()])


def test_the_pose_loss_is_small_at_the_truth_and_its_gradient_reaches_the_encoder(encoder, clouds):
    still = Augment(rotation=0, shift=0, offset=0, noise=0, overlap=1, density=1)
    turned = Augment(rotation=90, shift=0, offset=0, noise=0, overlap=1, density=1)
    at_truth, away = (
        pose_loss(encoder, pairs.source, pairs.target, pairs.truth, iterations=2)
        for pairs in (draw_pairs(clouds, 6, 128, augment, generator()) for augment in (still, turned))
    )
    assert at_truth.item() < away.item()
    encoder.zero_grad()
    away.backward()
    assert all(bool(torch.isfinite(p.grad).all()) and float(p.grad.abs().sum()) > 0 for p in encoder.parameters())


def test_the_anchor_loss_falls_until_each_channel_peaks_at_its_own_anchor():
    torch.manual_seed(0)
    encoder, anchors = Encoder(8, (32, 32)), draw_anchors(8, generator())
    assert float(anchors.norm(dim=1).max()) <= 0.7
    optimiser, draw, losses = torch.optim.Adam(encoder.parameters(), 1e-2), generator(), []
    for _ in range(300):
        loss = anchor_loss(encoder, anchors, 0.3, 512, draw)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 20
    own = encoder.pointwise(anchors).argmax(0)  # of all anchors, which one each channel is largest at
    assert (own == torch.arange(8)).float().mean() >= 0.75
