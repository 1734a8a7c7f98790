"""The encoder F: a PointNet without its transform nets, and the exact Jacobian of F with respect to the pose.

F(P) = max over points p of f(p), f a shared MLP 3-64-64-64-128-K (Qi et al. 2017; K = 1024 in the paper). There is no
batch normalisation: nothing to switch between training and use, and no cloud's feature depends on its batch.
"""

from __future__ import annotations

import itertools
from typing import cast

import torch
from torch import Tensor, nn

from fmr_cli.feature_metric.inverse_compositional import chain, pose_jacobian
from fmr_cli.feature_metric.layers import Layers

HIDDEN = (64, 64, 64, 128)  # units of each layer: the paper's
FEATURE_DIM = 1024  # channels K: the paper's


class Encoder(nn.Module):
    """f: R³ -> R^K pointwise and F, its maximum over a cloud."""

    def __init__(self, feature_dim: int = FEATURE_DIM, hidden: tuple[int, ...] = HIDDEN) -> None:
        super().__init__()
        widths = (3, *hidden, feature_dim)
        self.hidden, self.feature_dim = tuple(hidden), feature_dim
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(widths))

    @property
    def linear(self) -> list[nn.Linear]:
        """The MLP's layers, by their type."""
        return [cast(nn.Linear, layer) for layer in self.layers]

    @property
    def weights(self) -> list[Tensor]:
        """The layers' matrices (out, in)."""
        return [layer.weight for layer in self.linear]

    @classmethod
    def of(cls, layers: Layers) -> Encoder:
        """An encoder with the weights of ``layers``, which take no gradient."""
        encoder = cls(len(layers[-1][1]), tuple(len(b) for _, b in layers[:-1]))
        for layer, (W, b) in zip(encoder.linear, layers, strict=True):
            layer.weight.data, layer.bias.data = torch.from_numpy(W), torch.from_numpy(b)
        return encoder.eval().requires_grad_(False)

    def arrays(self) -> Layers:
        """The weights in numpy."""
        return [(layer.weight.detach().cpu().numpy(), layer.bias.detach().cpu().numpy()) for layer in self.linear]

    def pointwise(self, points: Tensor) -> Tensor:
        """f of every point: (..., 3) -> (..., K). The last layer is linear, so that every channel keeps a gradient."""
        x = points
        for layer in self.layers[:-1]:
            x = torch.relu(layer(x))
        return self.layers[-1](x)

    def forward(self, points: Tensor, chunk: int = 2048) -> Tensor:
        """F of every cloud: (B, N, 3) -> (B, K). A running maximum keeps the B x N x K activation in cache."""
        feature = self.pointwise(points[:, :chunk]).amax(-2)  # without the index, nearly twice as fast as max
        for first in range(chunk, points.shape[1], chunk):
            feature = torch.maximum(feature, self.pointwise(points[:, first : first + chunk]).amax(-2))
        return feature

    def encode(self, points: Tensor, chunk: int = 2048) -> tuple[Tensor, Tensor]:
        """F with the critical points: (B, N, 3) -> feature (B, K), index (B, K) of the point that set each channel.

        The feature is that of ``forward``.
        """
        feature, index = self.pointwise(points[:, :chunk]).max(-2)
        for first in range(chunk, points.shape[1], chunk):
            value, where = self.pointwise(points[:, first : first + chunk]).max(-2)
            better = value > feature
            feature = torch.where(better, value, feature)
            index = torch.where(better, where + first, index)
        return feature, index

    def critical_gradients(self, points: Tensor, index: Tensor) -> Tensor:
        """df_k/dp at the critical point of each channel: points (B, N, 3), index (B, K) -> (B, K, 3).

        Channel k goes back through the MLP from its own row of the last layer, at its own point.
        """
        x = points.gather(1, index[..., None].expand(-1, -1, 3))  # [B x K x 3]
        return chain(self.weights, self.active(x))

    def active(self, x: Tensor) -> list[Tensor]:
        """Which units of each hidden layer are on at points (..., 3): a list of (..., width)."""
        on = []
        for layer in self.layers[:-1]:
            x = layer(x)
            on.append(x > 0)
            x = torch.relu(x)
        return on


def jacobian(encoder: Encoder, points: Tensor, index: Tensor) -> Tensor:
    """J of F(exp(-xi) P) at xi = 0, exact, from the critical points: (B, N, 3), (B, K) -> (B, K, 6)."""
    p = points.gather(1, index[..., None].expand(-1, -1, 3))
    return pose_jacobian(p, encoder.critical_gradients(points, index))
