"""The decoder of the paper: four fully connected layers with LeakyReLU, a feature back to a cloud. For training."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

WIDTHS = (1024, 512, 256)  # units of the hidden layers: the paper's four layers with the output


class Decoder(nn.Module):
    """(B, K) feature -> (B, N, 3) points, as many as the encoder was given."""

    def __init__(self, feature_dim: int, points: int, widths: tuple[int, int, int] = WIDTHS) -> None:
        super().__init__()
        sizes = (feature_dim, *widths, 3 * points)
        layers: list[nn.Module] = []
        for a, b in itertools.pairwise(sizes):
            layers += [nn.Linear(a, b), nn.LeakyReLU()]
        self.net = nn.Sequential(*layers[:-1])  # coordinates are signed: none after the last

    def forward(self, feature: Tensor) -> Tensor:
        return self.net(feature).reshape(len(feature), -1, 3)


def chamfer(a: Tensor, b: Tensor) -> Tensor:
    """Symmetric Chamfer distance of (B, N, 3) and (B, M, 3): mean squared distance to the nearest, both ways -> (B,).

    Who is nearest is found without a gradient, by matrix products; the gradient needs the N + M chosen pairs alone.
    """
    with torch.no_grad():
        square = a.square().sum(-1)[..., None] + b.square().sum(-1)[:, None] - 2 * a @ b.mT  # [B x N x M]
        nearest_b, nearest_a = square.min(2).indices, square.min(1).indices  # faster on the CPU than argmin
    return _distance2(a, b, nearest_b) + _distance2(b, a, nearest_a)


def _distance2(points: Tensor, others: Tensor, index: Tensor) -> Tensor:
    """Mean squared distance of points (B, N, 3) to others[index], index (B, N): -> (B,)."""
    return (points - others.gather(1, index[..., None].expand(-1, -1, 3))).square().sum(-1).mean(1)
