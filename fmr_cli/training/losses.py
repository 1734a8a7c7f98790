"""The two losses of the paper: Chamfer through the decoder (no label needed), and the point error of the unrolled IC.

Before them comes ``anchor_loss``, which needs no clouds. Both of the paper's reach the encoder through the critical
points alone. Which points those are is found without a gradient and, where that is faster, in bfloat16; their values
are exact, and each such point goes through the network once.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.inverse_compositional import MAX_STEP, capped, chain, pose_jacobian, robust_weight
from fmr_cli.geometry import se3
from fmr_cli.synthetic.batches import random_directions

DAMPING = 1e-4  # of the mean diagonal of JᵀWJ: keeps an early, badly determined step from blowing up the gradient
# Radii of the balls that anchors and points are drawn in, in units of the normalised cloud, whose corners are at 0.87:
# anchors where clouds have points, points also beyond, where a channel has to fall off.
ANCHOR_REACH, POINT_REACH = 0.7, 1.2
NEAR = 0.05  # point error, in units of the normalised cloud, from which on its logarithm counts: about 5 deg


@dataclass
class Code:
    """F of a batch of clouds with a gradient, through its critical points alone.

    feature: (B, K); points: (U, 3), each critical point of the batch once; at: (B, K) which of them sets each channel.
    """

    feature: Tensor
    points: Tensor
    at: Tensor


def half_precision(device: torch.device) -> AbstractContextManager[object]:
    """Products in bfloat16 where that is faster: a CPU without units for it takes ten times as long (measured)."""
    slow = device.type == "cpu" and not torch.backends.cpu.get_cpu_capability().startswith("AVX512")
    return nullcontext() if slow else torch.autocast(device.type, torch.bfloat16)


@torch.no_grad()
def critical_index(encoder: Encoder, points: Tensor) -> Tensor:
    """(B, K) the point of each cloud (B, N, 3) that sets each channel, within the rounding of bfloat16.

    On a CPU cloud by cloud, which keeps the activation in cache.
    """
    with half_precision(points.device):
        x = points
        for layer in encoder.layers[:-1]:
            x = torch.relu(layer(x))
        at_once = 1 if points.device.type == "cpu" else len(x)
        weight = encoder.linear[-1].weight
        found = [torch.nn.functional.linear(c, weight).max(1).indices for c in torch.split(x, at_once)]
    return torch.cat(found)


def encode(encoder: Encoder, points: Tensor) -> Code:
    """F of clouds (B, N, 3)."""
    count, size = points.shape[:2]
    flat = critical_index(encoder, points) + size * torch.arange(count, device=points.device)[:, None]
    used = torch.zeros(count * size, dtype=torch.bool, device=points.device)
    used[flat] = True
    at = (used.cumsum(0) - 1)[flat]
    critical = points.reshape(-1, 3)[used]
    x = critical
    for layer in encoder.layers[:-1]:
        x = torch.relu(layer(x))
    rows = torch.nn.functional.embedding(at, x)  # [B x K x width]
    weight, bias = encoder.layers[-1].parameters()
    return Code(torch.einsum("bkw,kw->bk", rows, weight) + bias, critical, at)


def jacobian(encoder: Encoder, code: Code) -> Tensor:
    """J of F(exp(-xi) P) at xi = 0 with a gradient, (B, K, 6), as ``encoder.jacobian``."""
    on = [torch.nn.functional.embedding(code.at, mask.float()) for mask in encoder.active(code.points)]
    return pose_jacobian(code.points[code.at], chain(encoder.weights, on))


def draw_anchors(count: int, generator: torch.Generator) -> Tensor:
    """(count, 3) anchors, uniform in a ball that holds nearly every normalised cloud."""
    radius = ANCHOR_REACH * torch.rand(count, 1, generator=generator, device=generator.device) ** (1 / 3)
    return radius * random_directions(count, generator)


def anchor_loss(encoder: Encoder, anchors: Tensor, width: float, count: int, generator: torch.Generator) -> Tensor:
    """The mean squared error of f_k(p) = 1 / (1 + |p - a_k|² / width²), a_k the anchors (K, 3), on ``count`` points.

    F_k(P) then says how near P comes to a_k (basis point sets, Prokudin et al. 2019), and depends on what is there
    alone. Trained by the Chamfer or pose loss from nothing, f_k rises towards some side without end, as a support
    function does: F sees the cloud's extremes, which are what another scan's border cuts off.
    """
    radius = POINT_REACH * torch.rand(count, 1, generator=generator, device=anchors.device).sqrt()
    points = radius * random_directions(count, generator)
    wanted = 1 / (1 + torch.cdist(points, anchors).square() / width**2)
    return (encoder.pointwise(points) - wanted).square().mean()


def pose_loss(
    encoder: Encoder, source: Tensor, target: Tensor, truth: Tensor, iterations: int, robust: bool = True
) -> Tensor:
    """Point error of the unrolled IC: source, target (B, N, 3), truth T_target_source (B, 4, 4).

    The mean over pairs of log(1 + d / NEAR), d the RMS distance of g Q to truth Q, after each iteration; the i-th
    counts i-fold. The logarithm lets a pair that is nearly right pull as much as one that is lost.
    """
    wanted = se3.transform(truth, source)
    aim = encode(encoder, target)
    J_target = jacobian(encoder, aim)
    g = torch.eye(4, device=source.device).expand(len(source), 4, 4)
    loss = source.new_zeros(())
    for iteration in range(iterations):
        code = encode(encoder, se3.transform(g, source))
        r = code.feature - aim.feature
        J, weight = J_target, torch.ones_like(r)
        if robust:
            J = (J_target + jacobian(encoder, code)) / 2
            weight = constant_weight(J, r)
        WJ = weight[..., None] * J
        A, b = J.mT @ WJ, WJ.mT @ r[..., None]
        damping = DAMPING * A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(6, device=A.device)
        step = torch.linalg.solve(A + damping + 1e-12 * torch.eye(6, device=A.device), b)[..., 0]
        g = se3.exp(capped(step, MAX_STEP)) @ g
        distance = (se3.transform(g, source) - wanted).square().sum(-1).mean(-1).clamp_min(1e-12).sqrt()
        loss = loss + (iteration + 1) * torch.log1p(distance / NEAR).mean()
    return 2 * loss / (iterations * (iterations + 1))


@torch.no_grad()
def constant_weight(J: Tensor, r: Tensor) -> Tensor:
    """``robust_weight`` without a gradient; of what is not finite, any: the loss says so."""
    return robust_weight(J.double().nan_to_num(), r.double().nan_to_num()).to(r.dtype)
