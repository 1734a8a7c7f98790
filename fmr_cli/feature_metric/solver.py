"""The IC solver on the torch encoder: ``inverse_compositional`` for batches and GPUs, and the paper's Jacobian."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from fmr_cli.feature_metric import inverse_compositional as ic
from fmr_cli.feature_metric.encoder import Encoder, jacobian
from fmr_cli.feature_metric.inverse_compositional import Solution, Template
from fmr_cli.geometry import se3

FINITE_STEP = 0.02  # rad, and units of the normalised cloud: the paper's


def make_template(encoder: Encoder, target: Tensor, method: Literal["exact", "finite"] = "exact") -> Template[Tensor]:
    """F(P) and J of target (B, N, 3): "exact" through the critical points, or the paper's "finite" differences."""
    feature, index = encoder.encode(target)
    J = jacobian(encoder, target, index) if method == "exact" else finite_jacobian(encoder, target, feature)
    return ic.make_template(feature, J)


def finite_jacobian(encoder: Encoder, target: Tensor, feature: Tensor, step: float = FINITE_STEP) -> Tensor:
    """J by the paper's forward difference, (F(exp(-step e_i) P) - F(P)) / step: (B, N, 3), (B, K) -> (B, K, 6)."""
    twists = -step * torch.eye(6, dtype=target.dtype, device=target.device)
    columns = [encoder(se3.transform(se3.exp(twist), target)) - feature for twist in twists]
    return torch.stack(columns, -1) / step


def solve(
    encoder: Encoder,
    template: Template[Tensor],
    source: Tensor,
    g: Tensor,
    iterations: int = 10,
    robust: bool = True,
    basis: Tensor | None = None,
) -> Solution[Tensor]:
    """Iterate from g (B, 4, 4) on source (B, N, 3), see ``inverse_compositional.iterate``."""

    def look(g: Tensor, derivative: bool) -> tuple[Tensor, Tensor | None]:
        moved = se3.transform(g, source)
        if not derivative:
            return encoder(moved), None
        feature, index = encoder.encode(moved)
        return feature, jacobian(encoder, moved, index)

    return ic.iterate(look, template, g, iterations, robust, basis)


class OnDevice:
    """A ``search.Solver``, numpy in and out, computed on the device of a torch encoder.

    threads: of the CPU's solver; here without meaning.
    """

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self.device = encoder, next(encoder.parameters()).device

    def tensor(self, x: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(x, np.float32)).to(self.device)

    @torch.inference_mode()
    def template(self, target: np.ndarray, threads: int = 1) -> Template[np.ndarray]:
        """F(P) and its exact Jacobian: target (N, 3)."""
        made = make_template(self.encoder, self.tensor(target)[None])
        return Template(*(x[0].cpu().numpy() for x in (made.feature, made.J, made.seen)))

    @torch.inference_mode()
    def solve(
        self,
        template: Template[np.ndarray],
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
        threads: int = 1,
    ) -> Solution[np.ndarray]:
        """``solve`` from each g (S, 4, 4) on source (N, 3)."""
        J, seen = (torch.from_numpy(x)[None].to(self.device) for x in (template.J, template.seen))
        known = Template(self.tensor(template.feature)[None], J, seen)
        points = self.tensor(source).expand(len(g), -1, -1)
        twists = None if basis is None else torch.from_numpy(basis).to(self.device)
        found = solve(self.encoder, known, points, self.tensor(g), iterations, robust, twists)
        return Solution(found.g.double().cpu().numpy(), found.errors.cpu().numpy(), template.rank)
