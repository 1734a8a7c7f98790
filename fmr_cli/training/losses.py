"""The two losses of the paper: Chamfer through the decoder (no label needed), and the point error of the unrolled IC.

Both reach the encoder through the critical points alone. Which points those are is found without a gradient and in
bfloat16, which is faster; their values are exact.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fmr_cli.feature_metric import se3
from fmr_cli.feature_metric.decoder import Decoder, chamfer
from fmr_cli.feature_metric.encoder import Encoder, jacobian
from fmr_cli.feature_metric.solver import SCALE_FROM, SCALE_TO, geman_mcclure

DAMPING = 1e-4  # of the mean diagonal of JᵀWJ: keeps an early, badly determined step from blowing up the gradient
CLIP = 1.0  # largest point error that still pulls, in units of the normalised cloud


def feature(encoder: Encoder, points: Tensor) -> tuple[Tensor, Tensor]:
    """F with a gradient, and the critical points: (B, N, 3) -> feature (B, K), index (B, K)."""
    x = points
    for layer in encoder.layers[:-1]:
        x = torch.relu(layer(x))
    weight, bias = encoder.layers[-1].parameters()
    with torch.no_grad(), torch.autocast(points.device.type, torch.bfloat16):
        index = torch.nn.functional.linear(x, weight).max(1).indices  # [B x K]; faster on the CPU than argmax
    at = x.gather(1, index[..., None].expand(-1, -1, x.shape[-1]))  # [B x K x width]
    return torch.einsum("bkw,kw->bk", at, weight) + bias, index


def autoencoder_loss(encoder: Encoder, decoder: Decoder, points: Tensor, whole: Tensor) -> Tensor:
    """Chamfer distance of what the decoder makes of F(points) to ``whole``, another sample of the same surface."""
    return chamfer(decoder(feature(encoder, points)[0]), whole).mean()


def pose_loss(
    encoder: Encoder, source: Tensor, target: Tensor, truth: Tensor, iterations: int, robust: bool = True
) -> Tensor:
    """Point error of the unrolled IC: source, target (B, N, 3), truth T_target_source (B, 4, 4).

    The mean distance of g Q to truth Q after each iteration, averaged over the iterations: a start far off is pulled
    too, not only the last step.
    """
    wanted = se3.transform(truth, source)
    aim, index = feature(encoder, target)
    J = jacobian(encoder, target, index)
    g = torch.eye(4, device=source.device).expand(len(source), 4, 4)
    loss = source.new_zeros(())
    for iteration in range(iterations):
        moved = se3.transform(g, source)
        r = feature(encoder, moved)[0] - aim
        fall = SCALE_FROM + (SCALE_TO - SCALE_FROM) * iteration / max(iterations - 1, 1)
        weight = geman_mcclure(r, fall).detach() if robust else torch.ones_like(r)
        WJ = weight[..., None] * J
        A, b = J.mT @ WJ, WJ.mT @ r[..., None]
        damping = DAMPING * A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(6, device=A.device)
        step = torch.linalg.solve(A + damping + 1e-12 * torch.eye(6, device=A.device), b)[..., 0]
        step = step / step.norm(dim=-1, keepdim=True).clamp_min(1.0)  # the solver's cap of one radian
        g = se3.exp(step) @ g
        distance = (se3.transform(g, source) - wanted).square().sum(-1).mean(-1).clamp_min(1e-12).sqrt()
        loss = loss + distance.clamp_max(CLIP).mean() / iterations
    return loss
