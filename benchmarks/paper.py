"""The paper's algorithm (Huang et al. 2020) as one writes it down in PyTorch: what the speed is compared with.

One activation of 1024 x N for the whole cloud, J by finite differences (six more passes), its pseudo-inverse once, and
one pass an iteration.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.geometry import se3

STEP = 0.02  # of the finite differences, the paper's


class PointNet(nn.Module):
    """Shared MLPs as convolutions of width 1, a maximum over the points; the weights of an ``Encoder``.

    normalised: with PointNet's batch normalisation after each layer, here the identity.
    """

    def __init__(self, encoder: Encoder, normalised: bool = False) -> None:
        super().__init__()
        widths = (3, *encoder.hidden, encoder.feature_dim)
        steps: list[nn.Module] = []
        for (a, b), linear in zip(itertools.pairwise(widths), encoder.linear, strict=True):
            layer = nn.Conv1d(a, b, 1)
            layer.weight.data, layer.bias = linear.weight.data[..., None], linear.bias
            steps += [layer, *([nn.BatchNorm1d(b, eps=0)] if normalised else []), nn.ReLU()]
        self.mlp = nn.Sequential(*steps[:-1])
        self.eval()

    def forward(self, points: Tensor) -> Tensor:
        """(B, N, 3) -> (B, K)."""
        return self.mlp(points.transpose(1, 2)).max(2).values


@torch.no_grad()
def solve(net: PointNet, source: Tensor, target: Tensor, iterations: int = 10) -> Tensor:
    """T_target_source (1, 4, 4) from source (1, N, 3) and target (1, M, 3)."""
    feature = net(target)
    twists = -STEP * torch.eye(6)
    J = torch.stack([(net(se3.transform(se3.exp(twist), target)) - feature) / STEP for twist in twists], -1)
    inverse = torch.linalg.pinv(J)
    g = torch.eye(4)[None]
    for _ in range(iterations):
        r = net(se3.transform(g, source)) - feature
        g = se3.exp((inverse @ r[..., None])[..., 0]) @ g
    return g
