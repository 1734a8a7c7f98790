"""The decoder of the paper: four fully connected layers with LeakyReLU, a feature back to a cloud. For training alone."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTHS = (1024, 512, 256)


class Decoder(nn.Module):
    """(B, K) feature -> (B, N, 3) points, as many as the encoder was given."""

    def __init__(self, feature_dim: int, points: int, widths: tuple[int, int, int] = WIDTHS) -> None:
        super().__init__()
        sizes = (feature_dim, *widths, 3 * points)
        layers: list[nn.Module] = []
        for a, b in zip(sizes[:-1], sizes[1:], strict=True):
            layers += [nn.Linear(a, b), nn.LeakyReLU()]
        self.net = nn.Sequential(*layers[:-1])  # coordinates are signed: none after the last

    def forward(self, feature: Tensor) -> Tensor:
        return self.net(feature).reshape(len(feature), -1, 3)


def chamfer(a: Tensor, b: Tensor) -> Tensor:
    """Symmetric Chamfer distance of point sets (B, N, 3) and (B, M, 3): mean squared distance to the nearest, both ways."""
    square = torch.cdist(a, b, compute_mode="use_mm_for_euclid_dist").square()  # [B x N x M]
    return square.amin(2).mean(1) + square.amin(1).mean(1)
