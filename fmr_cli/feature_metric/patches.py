"""The feature metric of local patches: the inverse compositional iteration, patch by patch, for part overlap.

A maximum over the whole cloud cannot ignore what the other scan does not have. So the target is covered by balls, each
with its own feature

    F_c(P) = max over p in P with |u| < 1 of (1 - |u|²) f(u),   u = (p - c) / radius

with f the encoder's first layers. The factor (1 - |u|²) lets a point enter or leave the ball without a jump. The
Jacobian comes once from the target's critical points, as for the global feature; every iteration weights each ball by
its residual (Geman-McClure), so that balls without a counterpart drop out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fmr_cli.feature_metric import se3
from fmr_cli.feature_metric.encoder import Encoder, chain
from fmr_cli.feature_metric.solver import capped, constrained_step

LAYERS = 3  # of the encoder: 64-64-64
MIN_SHARE = 0.35  # of the target's points a ball must hold of the source
SCALE_FROM, SCALE_TO = 3.0, 1.0  # the robust scale's factor over the iterations, times the median residual
MAX_STEP = 0.5

# (centres (P, 3)) -> offsets (P, n, 3) in radii, valid (P, n), how many points each ball holds (P,)
Neighbourhoods = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]


@dataclass
class PatchTemplate:
    """The target's side. centres (P, 3); feature (P, C); J (P, C, 6); JtJ (P, 6, 6); count (P,) points in each ball."""

    centres: Tensor
    feature: Tensor
    J: Tensor
    JtJ: Tensor
    count: Tensor


@dataclass
class PatchFit:
    """g (4, 4); error (P,) the patches' |r| at g, NaN where not co-occupied; weight (P,); information (6, 6) at g."""

    g: Tensor
    error: Tensor
    weight: Tensor
    information: Tensor


def patch_features(encoder: Encoder, offsets: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """F_c of every ball and the critical point of each channel: (P, n, 3), (P, n) -> (P, C), (P, C)."""
    x = offsets
    for layer in encoder.linear[:LAYERS]:
        x = torch.relu_(layer(x))
    window = (1 - offsets.square().sum(-1)).clamp_min(0) * valid
    return (x * window[..., None]).max(1)


def patch_template(encoder: Encoder, centres: Tensor, neighbourhoods: Neighbourhoods, radius: float) -> PatchTemplate:
    """F_c and its exact Jacobian at the target; centres and radius in the target's normalised frame."""
    offsets, valid, count = neighbourhoods(centres)
    feature, index = patch_features(encoder, offsets, valid)
    u = offsets.gather(1, index[..., None].expand(-1, -1, 3))  # [P x C x 3]
    layers, on, x = encoder.linear[:LAYERS], [], u
    for layer in layers[:-1]:
        x = layer(x)
        on.append(x > 0)
        x = torch.relu(x)
    slope = chain(layers, on)  # df/du before the last ReLU, which is on wherever the feature is above 0
    value = (x * layers[-1].weight).sum(-1) + layers[-1].bias
    # d[(1 - |u|²) f(u)]/du = (1 - |u|²) df/du - 2 u f
    window = 1 - u.square().sum(-1, keepdim=True)
    gradient = (window * slope - 2 * u * value[..., None]) / radius
    p = centres[:, None] + radius * u
    J = -torch.cat([torch.linalg.cross(p, gradient), gradient], -1) * (feature > 0)[..., None]
    return PatchTemplate(centres, feature, J, J.mT @ J, count)


def refine(
    encoder: Encoder,
    template: PatchTemplate,
    neighbourhoods: Neighbourhoods,
    g: Tensor,
    iterations: int,
    basis: Tensor | None = None,
) -> PatchFit:
    """Iterate from g (4, 4), float64; ``neighbourhoods`` looks balls up in the source's own frame.

    basis: (6, d) orthonormal twists that the motion may use; None for all six.
    """
    for iteration in range(iterations + 1):
        inverse = torch.linalg.inv(g)
        there = template.centres.double() @ inverse[:3, :3].T + inverse[:3, 3]
        offsets, valid, count = neighbourhoods(there)
        feature, _ = patch_features(encoder, offsets @ g[:3, :3].T.to(offsets), valid)
        r = feature - template.feature
        error = r.norm(dim=1)
        occupied = count >= MIN_SHARE * template.count
        if int(occupied.sum()) < 3:
            nothing = torch.zeros_like(error)
            return PatchFit(g, torch.full_like(error, torch.nan), nothing, torch.zeros(6, 6).double())
        fall = SCALE_FROM + (SCALE_TO - SCALE_FROM) * min(iteration / max(iterations - 1, 1), 1.0)
        s2 = (fall * error[occupied].median()).square().clamp_min(1e-12)
        weight = (s2 / (s2 + error.square())).square() * occupied
        A = torch.einsum("p,pij->ij", weight, template.JtJ).double()
        if iteration == iterations:
            break
        b = torch.einsum("p,pci,pc->i", weight, template.J, r).double()
        step = constrained_step(A, b, basis)
        g = se3.exp(capped(step, MAX_STEP)) @ g
    # A per-channel variance from the weighted residuals turns J'WJ into an information matrix.
    variance = (weight[:, None] * r.square()).sum().double() / (weight.sum().double() * r.shape[1]).clamp_min(1e-12)
    return PatchFit(g, torch.where(occupied, error, torch.nan), weight, A / variance.clamp_min(1e-12))
