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
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from fmr_cli.feature_metric import fast
from fmr_cli.feature_metric.encoder import Encoder, jacobian
from fmr_cli.feature_metric.fast import MAX_STEP, RANK_TOLERANCE, SCALES, STOP_STEP
from fmr_cli.geometry import se3

FINITE_STEP = 0.02  # the paper's


@dataclass
class Template:
    """What the solver keeps of the target P, computed once. feature: (B, K); J: (B, K, 6).

    seen: (B, 6, 6), the projector onto the directions that JᵀJ sees; no step leaves them. J is float64: the products
    JᵀWJ of float32 would bury the zero eigenvalues of a point or a line in rounding.
    """

    feature: Tensor
    J: Tensor
    seen: Tensor

    @property
    def rank(self) -> Tensor:
        """(B,) of JᵀJ."""
        return self.seen.diagonal(dim1=-2, dim2=-1).sum(-1).round().long()


@dataclass
class Solution:
    """g: (B, 4, 4); errors: (iterations + 1, B) mean |r| before each iteration and after the last; rank: (B,) of JᵀJ.

    A rank under 6 says that the target does not determine the pose (one point, a line): the undetermined directions
    are left where they were.
    """

    g: Tensor
    errors: Tensor
    rank: Tensor

    @property
    def error(self) -> Tensor:
        """(B,) the last mean |r|."""
        return self.errors[-1]


def make_template(encoder: Encoder, target: Tensor, method: Literal["exact", "finite"] = "exact") -> Template:
    """F(P) and J of target (B, N, 3): "exact" through the critical points, or the paper's "finite" differences."""
    feature, index = encoder.encode(target)
    J = jacobian(encoder, target, index) if method == "exact" else finite_jacobian(encoder, target, feature)
    J = J.double()
    eigenvalues, V = torch.linalg.eigh(J.mT @ J)
    V = V * (eigenvalues > RANK_TOLERANCE * eigenvalues[:, -1:].clamp_min(1e-30))[:, None]
    return Template(feature, J, V @ V.mT)


def finite_jacobian(encoder: Encoder, target: Tensor, feature: Tensor, step: float = FINITE_STEP) -> Tensor:
    """J by the paper's forward difference, (F(exp(-step e_i) P) - F(P)) / step: (B, N, 3), (B, K) -> (B, K, 6)."""
    twists = -step * torch.eye(6, dtype=target.dtype, device=target.device)
    columns = [encoder(se3.transform(se3.exp(twist), target)) - feature for twist in twists]
    return torch.stack(columns, -1) / step


def solve(
    encoder: Encoder,
    template: Template,
    source: Tensor,
    g: Tensor,
    iterations: int = 10,
    robust: bool = True,
    basis: Tensor | None = None,
) -> Solution:
    """Iterate from g (B, 4, 4) on source (B, N, 3); the template's batch is B, or 1 and shared by all.

    basis: (6, d) orthonormal twists that the motion may use; None for all six.
    Stops early once no step of the batch exceeds ``STOP_STEP``.
    """
    errors = []
    g = g.clone()
    for _ in range(iterations):
        moved = se3.transform(g, source)
        feature, index = encoder.encode(moved) if robust else (encoder(moved), None)
        r = feature - template.feature
        errors.append(r.abs().mean(-1))
        J, weight = template.J, torch.ones_like(r)
        if index is not None:
            J = (J + jacobian(encoder, moved, index).double() @ template.seen) / 2
            weight = robust_weight(J, r, basis)
        step = capped(least_squares(J, weight, r, basis), MAX_STEP).to(r.dtype)
        g = se3.exp(step) @ g
        if float(step.abs().max()) < STOP_STEP:
            break
    r = encoder(se3.transform(g, source)) - template.feature
    errors.append(r.abs().mean(-1))
    return Solution(g, torch.stack(errors), template.rank.expand(len(g)))


def geman_mcclure(e: Tensor, factor: float) -> Tensor:
    """(s² / (s² + e²))² with s = factor times the median |e| of each row: (..., K) -> (..., K)."""
    s2 = (factor * e.abs().median(-1, keepdim=True).values).square().clamp_min(1e-24)
    return (s2 / (s2 + e * e)).square()


def robust_weight(J: Tensor, r: Tensor, basis: Tensor | None = None) -> Tensor:
    """The channels' weights in the robust regression of r (B, K) on J (B, K, 6) float64: (B, K) float64.

    Of what a step leaves over, r - J dtheta, not of r: a channel that moves with the cloud is no outlier, however large
    its r. The scale falls (graduated non-convexity), so that the first step is nearly the least squares one.
    """
    r = r.double()
    weight = torch.ones_like(r)
    for factor in SCALES:
        dtheta = least_squares(J, weight, r, basis)
        weight = geman_mcclure(r - (J @ dtheta[..., None])[..., 0], factor)
    return weight


def least_squares(J: Tensor, weight: Tensor, r: Tensor, basis: Tensor | None = None) -> Tensor:
    """dtheta of (JᵀWJ) dtheta = JᵀW r: J (B or 1, K, 6) float64, weight and r (B, K) -> (B, 6) float64."""
    WJ = weight[..., None] * J
    return constrained_step(J.mT @ WJ, (WJ.mT @ r.double()[..., None])[..., 0], basis)


def constrained_step(A: Tensor, b: Tensor, basis: Tensor | None) -> Tensor:
    """The step of A dtheta = b, (..., 6, 6) and (..., 6) float64, within the span of basis (6, d).

    By eigenvectors: directions that A does not see get no step, rather than a huge one.
    """
    B = torch.eye(6, dtype=A.dtype, device=A.device) if basis is None else basis.to(A)
    eigenvalues, V = torch.linalg.eigh(B.mT @ A @ B)
    seen = eigenvalues > RANK_TOLERANCE * eigenvalues[..., -1:].clamp_min(1e-30)
    inverse = torch.where(seen, 1 / eigenvalues.clamp_min(1e-30), 0.0)
    return (B @ (V @ (inverse[..., None] * (V.mT @ (B.mT @ b[..., None])))))[..., 0]


def capped(step: Tensor, size: float) -> Tensor:
    """The step (..., 6), shortened where its norm exceeds ``size``."""
    return step * (size / step.norm(dim=-1, keepdim=True).clamp_min(1e-30)).clamp_max(1.0)


class OnDevice:
    """A ``search.Solver``, numpy in and out, computed on the device of a torch encoder.

    threads: of the CPU's solver; here without meaning.
    """

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self.device = encoder, next(encoder.parameters()).device

    def tensor(self, x: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(x, np.float32)).to(self.device)

    @torch.inference_mode()
    def template(self, target: np.ndarray, threads: int = 1) -> fast.Template:
        """F(P) and its exact Jacobian: target (N, 3)."""
        made = make_template(self.encoder, self.tensor(target)[None])
        return fast.Template(*(x[0].cpu().numpy() for x in (made.feature, made.J, made.seen)))

    @torch.inference_mode()
    def solve(
        self,
        template: fast.Template,
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
        threads: int = 1,
    ) -> fast.Solution:
        """``solve`` from each g (S, 4, 4) on source (N, 3)."""
        J, seen = (torch.from_numpy(x)[None].to(self.device) for x in (template.J, template.seen))
        known = Template(self.tensor(template.feature)[None], J, seen)
        points = self.tensor(source).expand(len(g), -1, -1)
        twists = None if basis is None else torch.from_numpy(basis)
        found = solve(self.encoder, known, points, self.tensor(g), iterations, robust, twists)
        return fast.Solution(found.g.double().cpu().numpy(), found.errors.cpu().numpy(), template.rank)
