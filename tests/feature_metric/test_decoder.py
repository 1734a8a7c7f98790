"""The decoder and the distance it is trained by."""

from __future__ import annotations

import torch
from torch import nn

from fmr_cli.feature_metric.decoder import Decoder, chamfer


def test_four_layers_and_as_many_points_out_as_asked() -> None:
    decoder = Decoder(feature_dim=128, points=77)
    assert decoder(torch.randn(5, 128)).shape == (5, 77, 3)
    assert sum(isinstance(m, nn.Linear) for m in decoder.modules()) == 4
    assert sum(isinstance(m, nn.LeakyReLU) for m in decoder.modules()) == 3


def test_chamfer_is_zero_for_the_same_set_in_any_order_and_counts_both_ways() -> None:
    a = torch.randn(2, 30, 3, generator=torch.Generator().manual_seed(0))
    assert chamfer(a, a[:, torch.randperm(30)]).abs().max() < 1e-6
    far = torch.cat([a, torch.full((2, 1, 3), 10.0)], 1)  # one point more on one side is seen from that side
    assert (chamfer(a, far) > 1).all()
    torch.testing.assert_close(chamfer(a, far), chamfer(far, a))
    one, two = torch.zeros(1, 1, 3), torch.tensor([[[3.0, 0, 0], [0, 4.0, 0]]])
    assert chamfer(one, two).item() == 9 + (9 + 16) / 2
