"""Which motions are allowed: all rigid ones, or those that keep the vertical, the heading or the plane.

Each is a subgroup: a solver whose every step lies in ``basis`` never leaves it, and nothing is projected afterwards.
All arrays are float64; what is float32 comes from elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.dof import Dof
from fmr_cli.geometry.se3 import exp

TURNS = 24  # starts about one axis: 15 deg apart, a quarter of what the solver reaches (see search.STARTS)


@dataclass(frozen=True)
class Motion:
    """dof: "rigid"; "yaw": rotation about ``up``, any translation; "translation"; "planar": yaw, no shift along up.

    up: unit vector. lift: what "planar" keeps of the translation along up, in the frames in use.
    """

    dof: Dof = "rigid"
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    lift: float = 0.0

    def basis(self) -> np.ndarray:
        """Orthonormal twists (6, d), rotation first."""
        turns = {"rigid": np.eye(3), "translation": np.zeros((3, 0))}.get(self.dof, np.array(self.up)[:, None])
        shifts = np.eye(3)
        if self.dof == "planar":
            shifts = np.linalg.qr(np.column_stack([self.up, shifts]))[0][:, 1:3]
        basis = np.zeros((6, turns.shape[1] + shifts.shape[1]))
        basis[:3, : turns.shape[1]], basis[3:, turns.shape[1] :] = turns, shifts
        return basis

    def starts(self, count: int) -> np.ndarray:
        """Rotations (n, 4, 4) spread evenly over those allowed."""
        if self.dof == "rigid":
            return rotations(count)
        turns = np.arange(TURNS if self.dof != "translation" else 1) * (2 * math.pi / TURNS)
        return exp(np.hstack([turns[:, None] * self.up, np.zeros((len(turns), 3))]))

    def exact(self, T: np.ndarray) -> np.ndarray:
        """The allowed motion next to T (4, 4): what float32 arithmetic has rounded, put right."""
        T = T.copy()
        T[:3, :3] = self.rotation(T[:3, :3])
        if self.dof == "planar":
            T[:3, 3] += (self.lift - T[:3, 3] @ self.up) * np.array(self.up)
        return T

    def rotation(self, H: np.ndarray) -> np.ndarray:
        """The allowed rotations R that maximise tr(Rᵀ H): (..., 3, 3) -> (..., 3, 3).

        Kabsch where the rotation is free; in closed form about ``up`` otherwise.
        """
        if self.dof == "translation":
            return np.broadcast_to(np.eye(3), H.shape)
        if self.dof == "rigid":
            U, _, Vt = np.linalg.svd(H)
            U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
            return U @ Vt
        up = np.array(self.up)
        skew = [H[..., 2, 1] - H[..., 1, 2], H[..., 0, 2] - H[..., 2, 0], H[..., 1, 0] - H[..., 0, 1]]
        cosine = np.trace(H, axis1=-2, axis2=-1) - (H @ up) @ up
        angle = np.arctan2(np.stack(skew, -1) @ up, cosine)
        twist = angle[..., None] * up
        return exp(np.concatenate([twist, np.zeros_like(twist)], -1))[..., :3, :3]

    def fit(self, source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """The weighted least squares motions: source, target (B or 1, n, 3), weight (B, n) -> (B, 4, 4)."""
        products = moments(source, target)
        # Of points that all share, one product: a batch of products with one row each takes several times as long.
        return self.fit_sums(weight @ products[0] if len(products) == 1 else (weight[:, None] @ products)[:, 0])

    def fit_sums(self, sums: np.ndarray) -> np.ndarray:
        """The motions that ``fit`` gives, of the weighted sums of ``moments``: (B, 16) -> (B, 4, 4)."""
        means = sums[:, 1:] / np.maximum(sums[:, :1], 1e-12)
        a, b, products = means[:, :3], means[:, 3:6], means[:, 6:].reshape(-1, 3, 3)
        T = np.tile(np.eye(4), (len(sums), 1, 1))
        T[:, :3, :3] = self.rotation(products - b[:, :, None] * a[:, None])
        shift = b - (T[:, :3, :3] @ a[:, :, None])[..., 0]
        if self.dof == "planar":
            shift = shift + (self.lift - shift @ self.up)[:, None] * self.up
        T[:, :3, 3] = shift
        return T


def moments(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Of matched points s, t (..., n, 3): 1, s, t and the products t_i s_j, (..., n, 16)."""
    products = (target[..., :, None] * source[..., None, :]).reshape(*source.shape[:-1], 9)
    return np.concatenate([np.ones_like(source[..., :1]), source, target, products], -1)


def rotations(count: int) -> np.ndarray:
    """(count, 4, 4) rotations spread evenly over SO(3): the super-Fibonacci spiral (Alexa, CVPR 2022)."""
    phi, psi = math.sqrt(2), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    t, d = s / count, 2 * math.pi * s
    r, R = np.sqrt(t), np.sqrt(1 - t)
    T = np.tile(np.eye(4), (count, 1, 1))
    q = [r * np.cos(d / phi), R * np.sin(d / psi), R * np.cos(d / psi), r * np.sin(d / phi)]
    T[:, :3, :3] = Rotation.from_quat(np.stack(q, -1)).as_matrix()
    return T
