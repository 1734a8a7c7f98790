"""Which motions are allowed: all rigid ones, or those that keep the vertical, the heading or the plane.

Each is a subgroup: a solver whose every step lies in ``basis`` never leaves it, and nothing is projected afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fmr_cli.feature_metric import se3

Dof = Literal["rigid", "yaw", "translation", "planar"]
TURNS = 24  # starts about one axis: 15 deg apart


@dataclass(frozen=True)
class Motion:
    """dof: "rigid"; "yaw": rotation about ``up``, any translation; "translation"; "planar": yaw, no shift along up.

    up: unit vector. lift: what "planar" keeps of the translation along up, in the frames in use.
    """

    dof: Dof = "rigid"
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    lift: float = 0.0

    def basis(self) -> Tensor:
        """Orthonormal twists (6, d), rotation first, float64."""
        up = torch.tensor(self.up, dtype=torch.float64)
        shifts = torch.eye(3, dtype=torch.float64)
        if self.dof == "planar":
            shifts = torch.linalg.qr(torch.cat([up[:, None], shifts], 1))[0][:, 1:3]
        turns = {"rigid": torch.eye(3, dtype=torch.float64), "translation": torch.zeros(3, 0, dtype=torch.float64)}
        turn = turns.get(self.dof, up[:, None])
        return torch.block_diag(turn, shifts)

    def starts(self, count: int) -> Tensor:
        """Rotations (n, 4, 4), float64, spread evenly over those allowed."""
        if self.dof == "rigid":
            return rotations(count)
        turns = torch.arange(TURNS if self.dof != "translation" else 1, dtype=torch.float64) * (2 * math.pi / TURNS)
        twist = torch.cat([turns[:, None] * torch.tensor(self.up, dtype=torch.float64), torch.zeros(len(turns), 3)], 1)
        return se3.exp(twist)

    def exact(self, T: Tensor) -> Tensor:
        """The allowed motion next to T (..., 4, 4) float64: what float32 arithmetic has rounded, put right."""
        up = torch.tensor(self.up, dtype=T.dtype)
        q = se3.quaternion(T[..., :3, :3])
        if self.dof == "translation":
            q = torch.tensor([1.0, 0, 0, 0], dtype=T.dtype).expand_as(q)
        elif self.dof != "rigid":
            q = torch.cat([q[..., :1], (q[..., 1:] @ up)[..., None] * up], -1)
        T = T.clone()
        T[..., :3, :3] = se3.from_quaternion(q / q.norm(dim=-1, keepdim=True))
        if self.dof == "planar":
            T[..., :3, 3] += (self.lift - T[..., :3, 3] @ up)[..., None] * up
        return T

    def fit(self, source: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        """The weighted least squares motion: source, target (B, n, 3), weight (B, n) -> (B, 4, 4).

        Kabsch where the rotation is free; in closed form about ``up`` otherwise.
        """
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1e-12)
        a, b = (torch.einsum("bn,bni->bi", weight, x) for x in (source, target))
        x, y = source - a[:, None], target - b[:, None]
        T = torch.eye(4, dtype=source.dtype, device=source.device).repeat(len(source), 1, 1)
        up = torch.tensor(self.up, dtype=source.dtype, device=source.device)
        if self.dof == "rigid":
            U, _, Vt = torch.linalg.svd(torch.einsum("bn,bni,bnj->bij", weight, x, y))
            sign = torch.ones(len(U), 3, dtype=U.dtype, device=U.device)
            sign[:, 2] = torch.det(U @ Vt).sign()
            T[:, :3, :3] = Vt.mT @ (sign[..., None] * U.mT)
        elif self.dof != "translation":
            cosine = (weight * ((x * y).sum(-1) - (x @ up) * (y @ up))).sum(-1)
            sine = (weight * (torch.linalg.cross(x, y) @ up)).sum(-1)
            twist = torch.atan2(sine, cosine)[:, None] * up
            T = se3.exp(torch.cat([twist, torch.zeros_like(twist)], -1))
        shift = b - (T[:, :3, :3] @ a[..., None])[..., 0]
        if self.dof == "planar":
            shift = shift + (self.lift - shift @ up)[:, None] * up
        T[:, :3, 3] = shift
        return T


def rotations(count: int) -> Tensor:
    """(count, 4, 4) rotations spread evenly over SO(3): the super-Fibonacci spiral (Alexa, CVPR 2022)."""
    phi, psi = math.sqrt(2), 1.533751168755204288118041
    s = torch.arange(count, dtype=torch.float64) + 0.5
    t, d = s / count, 2 * math.pi * s
    r, R = t.sqrt(), (1 - t).sqrt()
    alpha, beta = d / phi, d / psi
    q = torch.stack([r * alpha.sin(), r * alpha.cos(), R * beta.sin(), R * beta.cos()], -1)
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3, :3] = se3.from_quaternion(q)
    return T


def rotation_between(a: Tensor, b: Tensor) -> Tensor:
    """The angle in radians between rotations (..., 3, 3), batch dimensions broadcast."""
    trace = torch.einsum("...ij,...ij->...", a, b)
    return ((trace - 1) / 2).clamp(-1, 1).arccos()
