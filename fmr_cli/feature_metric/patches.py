"""The feature metric of local patches: the inverse compositional iteration, patch by patch, for part overlap.

A maximum over the whole cloud cannot ignore what the other scan does not have. So the target is covered by balls, each
with its own feature

    F_c(P) = max over p in P with |u| < 1 of (1 - |u|²) f(u),   u = (p - c) / radius

with f the encoder's first layers. The factor (1 - |u|²) lets a point enter or leave the ball without a jump. The
Jacobian comes once from the target's critical points, as for the global feature (where asked for, its mean with the
moved source's); every iteration weights each ball by its residual (Geman-McClure), so that balls without a counterpart
drop out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmr_cli.feature_metric.inverse_compositional import capped, chain, constrained_step, pose_jacobian
from fmr_cli.feature_metric.layers import Layers, hidden
from fmr_cli.geometry.kernels import geman_mcclure
from fmr_cli.geometry.se3 import exp

LAYERS = 3  # of the encoder: 64-64-64
MIN_SHARE = 0.35  # of the target's points a ball must hold of the source
SCALE_FROM, SCALE_TO = 3.0, 1.0  # the robust scale's factor over the iterations, times the median residual
MAX_STEP = 0.5  # rad, and units of the normalised cloud: patches see less far than the whole
CHUNK = 16  # balls encoded at once: their activations stay in the processor's cache

# (centres (P, 3)) -> offsets (P, n, 3) in radii, valid (P, n), float32: how the points lie in the balls
Neighbourhoods = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass
class PatchTemplate:
    """The target's side.

    centres (P, 3); radius of the balls; feature (P, C); J (P, C, 6); JtJ (P, 6, 6); count (P,) points in each ball.
    """

    centres: np.ndarray
    radius: float
    feature: np.ndarray
    J: np.ndarray
    JtJ: np.ndarray
    count: np.ndarray


@dataclass
class PatchFit:
    """g (4, 4); error (P,) the patches' |r| at g, NaN where not co-occupied; weight (P,)."""

    g: np.ndarray
    error: np.ndarray
    weight: np.ndarray


def pointwise(layers: Layers, offsets: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(1 - |u|²) f(u) of every point of every ball: (P, n, 3), (P, n) -> (P, n, C)."""
    x = offsets.reshape(-1, 3)
    for weight, bias in layers[:LAYERS]:
        x = x @ weight.T
        x += bias
        np.maximum(x, 0, out=x)
    x = x.reshape(*offsets.shape[:2], -1)
    x *= (np.maximum(1 - (offsets * offsets).sum(-1), 0) * valid)[..., None]
    return x


def patch_features(layers: Layers, offsets: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """F_c of every ball: (P, n, 3), (P, n) -> (P, C)."""
    parts = [slice(i, i + CHUNK) for i in range(0, len(offsets), CHUNK)]
    return np.concatenate([pointwise(layers, offsets[part], valid[part]).max(1) for part in parts])


def patch_template(layers: Layers, centres: np.ndarray, look: Neighbourhoods, radius: float) -> PatchTemplate:
    """F_c and its exact Jacobian at the target; centres and radius in the target's normalised frame."""
    offsets, valid = look(centres)
    feature, J = feature_and_jacobian(layers, centres, offsets, valid, radius)
    return PatchTemplate(centres, radius, feature, J, np.swapaxes(J, 1, 2) @ J, valid.sum(1))


def feature_and_jacobian(
    layers: Layers, centres: np.ndarray, offsets: np.ndarray, valid: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """F_c (P, C) of points (P, n, 3) in balls about ``centres``, and dF_c(exp(-xi) x)/dxi at 0, exact: (P, C, 6)."""
    values = pointwise(layers, offsets, valid)
    index = values.argmax(1)  # [P x C], the critical points
    feature = np.take_along_axis(values, index[:, None], 1)[:, 0]
    u = np.take_along_axis(offsets, index[..., None], 1)  # [P x C x 3]
    x, on = hidden(layers[:LAYERS], u)
    weight, bias = layers[LAYERS - 1]
    value = (x * weight).sum(-1) + bias
    # df/du before the last ReLU, which is on wherever the feature is above 0
    slope = chain([W for W, _ in layers[:LAYERS]], on)
    # d[(1 - |u|²) f(u)]/du = (1 - |u|²) df/du - 2 u f
    window = 1 - (u * u).sum(-1, keepdims=True)
    gradient = (window * slope - 2 * u * value[..., None]) / radius
    p = centres[:, None] + radius * u
    return feature, pose_jacobian(p, gradient) * (feature > 0)[..., None]


def refine(
    layers: Layers,
    template: PatchTemplate,
    look: Neighbourhoods,
    g: np.ndarray,
    iterations: int,
    basis: np.ndarray | None = None,
    both: bool = False,
) -> PatchFit:
    """Iterate from g (4, 4), float64; ``look`` finds the balls' points in the source's own frame.

    basis: (6, d) orthonormal twists that the motion may use; None for all six. both: steps by the mean of the target's
    and the moved source's Jacobian, as for the global feature, rather than by the target's alone.
    """
    for iteration in range(iterations + 1):
        inverse = np.linalg.inv(g)
        offsets, valid = look(template.centres @ inverse[:3, :3].T + inverse[:3, 3])
        moved = offsets @ g[:3, :3].T.astype(np.float32)
        if both and iteration < iterations:
            feature, J_source = feature_and_jacobian(layers, template.centres, moved, valid, template.radius)
            J = (template.J + J_source) / 2
            JtJ = np.swapaxes(J, 1, 2) @ J
        else:
            feature, J, JtJ = patch_features(layers, moved, valid), template.J, template.JtJ
        r = feature - template.feature
        error = np.linalg.norm(r, axis=1)
        occupied = valid.sum(1) >= MIN_SHARE * template.count
        if occupied.sum() < 3:
            return PatchFit(g, np.full_like(error, np.nan), np.zeros_like(error))
        fall = SCALE_FROM + (SCALE_TO - SCALE_FROM) * min(iteration / max(iterations - 1, 1), 1.0)
        s2 = max((fall * np.median(error[occupied])) ** 2, 1e-12)
        weight = geman_mcclure(error**2, s2) * occupied
        if iteration < iterations:
            A = np.tensordot(weight, JtJ, 1)
            b = weight @ (r[:, None] @ J)[:, 0]
            g = exp(capped(constrained_step(A, b, basis), MAX_STEP)) @ g
    return PatchFit(g, np.where(occupied, error, np.nan), weight)
