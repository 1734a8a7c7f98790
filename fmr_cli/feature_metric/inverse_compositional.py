"""The inverse compositional (IC) iteration: find g that minimises ||F(P) - F(g Q)||², P the target, Q the source.

    once:            J = dF(exp(-xi) P)/dxi at xi = 0                                (on the target)
    every iteration: r = F(g Q) - F(P);  (JᵀJ) dtheta = Jᵀ r;  g <- exp(dtheta) g

since F(exp(dtheta) g Q) = F(P) holds to first order where F(g Q) = F(exp(-dtheta) P) = F(P) + J dtheta. That is the
paper's, and what ``robust=False`` does. By default two things differ:

1. J is the mean of the target's and of the same derivative of F(g Q): F(g Q) - F(P) = (J_P + J_gQ) dtheta / 2 to second
   order (efficient second-order minimisation, Malis 2004), and with half the error where other points come to set a
   channel on the way. Larger rotations are found, in fewer iterations. J_gQ costs little: each channel has one point.
2. The step minimises sum_k rho(r_k - J_k dtheta), rho Geman-McClure's. A max-pooled channel is set by one point, so
   that channels whose point lies outside the overlap are outliers; their weights W switch them off.

Numpy and torch alike: ``numpy_solver`` (one pair on the CPU) and ``solver`` (batches, GPU) bring the encoder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from array_api_compat import device

from fmr_cli.geometry.arrays import Array, median_magnitude, namespace
from fmr_cli.geometry.kernels import geman_mcclure
from fmr_cli.geometry.se3 import exp

MAX_STEP = 1.0  # rad, and units of the normalised cloud: beyond it no linearisation holds
# Of the robust regression, times the median |r - J dtheta|: from nearly least squares to 1.5, 1 sigma of normal noise.
SCALES = tuple(np.geomspace(6.0, 1.5, 10).tolist())
STOP_STEP = 1e-7  # rad, and units of the normalised cloud: the float32 rounding of its feature
RANK_TOLERANCE = 1e-9  # of the largest eigenvalue of JᵀJ: what rounding leaves of a zero one, J in float64
TINY = 1e-30  # keeps 0/0 out where every eigenvalue is zero
EXACT = 1e-24  # a feature unit squared: the kernel's least scale, where a copy leaves nothing over


@dataclass
class Template(Generic[Array]):
    """What the solver keeps of the target P, computed once. feature: (..., K) float32; J: (..., K, 6) float64.

    seen: (..., 6, 6) float64, the projector onto the directions that JᵀJ sees; no step leaves them. J is float64: the
    products JᵀWJ of float32 would bury the zero eigenvalues of a point or a line in rounding.
    """

    feature: Array
    J: Array
    seen: Array

    @property
    def rank(self) -> Array:
        """(...) of JᵀJ."""
        xp = namespace(self.seen)
        return xp.astype(xp.round(xp.linalg.trace(self.seen)), xp.int64)


@dataclass
class Solution(Generic[Array]):
    """g: (B, 4, 4); errors: (iterations + 1, B) mean |r| before each iteration and after the last.

    rank: of the template. Under 6, the target does not determine the pose (one point, a line): the undetermined
    directions are left where they were.
    """

    g: Array
    errors: Array
    rank: Array

    @property
    def error(self) -> Array:
        """(B,) the last mean |r|."""
        return self.errors[-1]


# Of poses g (B, 4, 4): F(g Q) (B, K); and where it is asked for, its derivative J_gQ (B, K, 6).
Look = Callable[[Array, bool], tuple[Array, Array | None]]


def make_template(feature: Array, J: Array) -> Template[Array]:
    """Of F(P) (..., K) and J (..., K, 6)."""
    xp = namespace(J)
    J = xp.astype(J, xp.float64)
    eigenvalues, V = xp.linalg.eigh(xp.matrix_transpose(J) @ J)
    V = V * xp.astype(eigenvalues > RANK_TOLERANCE * xp.maximum(eigenvalues[..., -1:], TINY), V.dtype)[..., None, :]
    return Template(feature, J, V @ xp.matrix_transpose(V))


def iterate(
    look: Look[Array], template: Template[Array], g: Array, iterations: int, robust: bool, basis: Array | None
) -> Solution[Array]:
    """From poses g (B, 4, 4), whose number format is kept; the template's batch is B, or one shared by all.

    basis: (6, d) float64 orthonormal twists that the motion may use; None for all six. Stops early once no step of the
    batch exceeds ``STOP_STEP``.
    """
    xp, errors = namespace(g), []
    for _ in range(iterations):
        feature, J_source = look(g, robust)
        r = feature - template.feature
        errors.append(xp.mean(xp.abs(r), axis=-1))
        dtheta = step(template, r, J_source, basis)
        g = exp(xp.astype(dtheta, g.dtype)) @ g
        if float(xp.max(xp.abs(dtheta))) < STOP_STEP:
            break
    errors.append(xp.mean(xp.abs(look(g, False)[0] - template.feature), axis=-1))
    return Solution(g, xp.stack(errors), template.rank)


def step(template: Template[Array], r: Array, J_source: Array | None, basis: Array | None) -> Array:
    """dtheta (B, 6) float64 at r (B, K): the paper's, or the robust one where J_gQ (B, K, 6) is given."""
    xp = namespace(r)
    r = xp.astype(r, xp.float64)
    if J_source is None:
        J, weight = template.J, xp.ones_like(r)
    else:
        J = (template.J + xp.astype(J_source, xp.float64) @ template.seen) / 2
        weight = robust_weight(J, r, basis)
    return capped(least_squares(J, weight, r, basis), MAX_STEP)


def robust_weight(J: Array, r: Array, basis: Array | None = None) -> Array:
    """The channels' weights in the robust regression of r (B, K) on J (B, K, 6), all float64: (B, K).

    Of what a step leaves over, r - J dtheta, not of r: a channel that moves with the cloud is no outlier, however large
    its r. The scale falls (graduated non-convexity), so that the first step is nearly the least squares one.
    """
    xp = namespace(r)
    weight = xp.ones_like(r)
    for factor in SCALES:
        dtheta = least_squares(J, weight, r, basis)
        left = r - (J @ dtheta[..., None])[..., 0]
        weight = geman_mcclure(left * left, xp.maximum((factor * median_magnitude(left)) ** 2, EXACT))
    return weight


def least_squares(J: Array, weight: Array, r: Array, basis: Array | None) -> Array:
    """dtheta of (JᵀWJ) dtheta = JᵀW r: J (B or 1, K, 6), weight and r (B, K) -> (B, 6), all float64."""
    WJ = weight[..., None] * J
    return constrained_step(namespace(J).matrix_transpose(WJ) @ J, (r[..., None, :] @ WJ)[..., 0, :], basis)


def constrained_step(A: Array, b: Array, basis: Array | None) -> Array:
    """The step of A dtheta = b, (..., 6, 6) and (..., 6), within the span of basis (6, d).

    By eigenvectors: directions that A does not see get no step, rather than a huge one.
    """
    xp = namespace(A)
    B = xp.eye(6, dtype=A.dtype, device=device(A)) if basis is None else basis
    eigenvalues, V = xp.linalg.eigh(B.T @ A @ B)
    seen = eigenvalues > RANK_TOLERANCE * xp.maximum(eigenvalues[..., -1:], TINY)
    inverse = xp.where(seen, 1 / xp.maximum(eigenvalues, TINY), xp.zeros_like(eigenvalues))
    V = B @ V
    return (V @ (inverse[..., None] * (xp.matrix_transpose(V) @ b[..., None])))[..., 0]


def capped(dtheta: Array, size: float) -> Array:
    """The step (..., 6), shortened where its norm exceeds ``size``."""
    xp = namespace(dtheta)
    return dtheta / xp.maximum(xp.linalg.vector_norm(dtheta, axis=-1, keepdims=True) / size, 1.0)


def chain(weights: Sequence[Array], on: Sequence[Array]) -> Array:
    """Rows of the product W_n D_(n-1) W_(n-1) ... D_1 W_1, D the layers' 0/1 masks ``on`` (..., K, width): (..., K, 3).

    The gradient of an MLP with weights W_i (out, in): row k of the last goes with the masks of channel k's own point.
    """
    row = weights[-1]
    for W, mask in zip(reversed(weights[:-1]), reversed(on), strict=True):
        row = (row * mask) @ W
    return row


def pose_jacobian(p: Array, gradient: Array) -> Array:
    """J of F(exp(-xi) P) at xi = 0, exact, from the critical points: p and df_k/dp (..., K, 3) -> (..., K, 6).

    F_k depends on the one point p that sets channel k, and d(exp(-xi) p) = -(omega × p + v), so that by the chain rule
    J_k = -(p × grad f_k, grad f_k).
    """
    xp = namespace(p)
    return -xp.concat([xp.linalg.cross(p, gradient), gradient], axis=-1)
