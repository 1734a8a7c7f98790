"""The encoder and the IC iteration without torch, for one cloud on the CPU: what ``encoder`` and ``solver`` compute.

Same equations, same schedule, same answer; arrays are numpy's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmr_cli.feature_metric.motion import exp
from fmr_cli.feature_metric.weight_file import read_weights

Layers = list[tuple[np.ndarray, np.ndarray]]  # (W (out, in), b (out,)) float32 of each

MAX_STEP = 1.0  # rad, and units of the normalised cloud
# Wide at first: channels that a large rotation moves are no outliers yet (from 4, success at 60 deg is 0.44, not 0.75).
SCALE_FROM, SCALE_TO = 12.0, 0.7  # the robust scale's factor over the iterations, times the mean |r|
STOP_STEP = 1e-7  # the float32 noise floor of a normalised cloud's feature
RANK_TOLERANCE = 1e-9  # of the largest eigenvalue of JᵀJ
CHUNK = 1024  # points; their K x CHUNK activation


@dataclass
class Template:
    """What the solver keeps of the target P. feature: (K,) float32; J: (K, 6) float64; rank: of JᵀJ."""

    feature: np.ndarray
    J: np.ndarray
    rank: int


@dataclass
class Solution:
    """g: (S, 4, 4) float64; errors: (iterations + 1, S) mean |r| before each iteration and after the last.

    A rank under 6 says that the target does not determine the pose (one point, a line): the undetermined directions
    are left where they were.
    """

    g: np.ndarray
    errors: np.ndarray
    rank: int

    @property
    def error(self) -> np.ndarray:
        """(S,) the last mean |r|."""
        return self.errors[-1]


class FastEncoder:
    """F and the solver on it, for one cloud on the CPU."""

    def __init__(self, layers: Layers) -> None:
        self.layers = layers

    @classmethod
    def load(cls, path: Path | str) -> FastEncoder:
        """The encoder of a .safetensors file. Raises ModelError where it is missing or does not fit."""
        return cls(read_weights(path).layers)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """F: (N, 3) -> (K,)."""
        return self.encode(points)[0]

    def pointwise(self, points: np.ndarray) -> np.ndarray:
        """f of every point: (N, 3) -> (K, N), points along the contiguous axis."""
        x = points.T.astype(np.float32)
        for W, b in self.layers[:-1]:
            x = W @ x
            x += b[:, None]
            np.maximum(x, 0, out=x)
        W, b = self.layers[-1]
        return W @ x + b[:, None]

    def encode(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F and the critical points: (N, 3) -> feature (K,), index (K,) of the point that set each channel."""
        features, indices = [], []
        for first in range(0, len(points), CHUNK):
            values = self.pointwise(points[first : first + CHUNK])
            where = values.argmax(1)
            features.append(values[np.arange(len(values)), where])
            indices.append(where + first)
        best = np.argmax(features, 0)[None]
        return np.take_along_axis(np.array(features), best, 0)[0], np.take_along_axis(np.array(indices), best, 0)[0]

    def template(self, target: np.ndarray) -> Template:
        """F(P) and its exact Jacobian, from the critical points: target (N, 3)."""
        feature, index = self.encode(target)
        J = self.jacobian(target, index).astype(np.float64)
        eigenvalues = np.linalg.eigvalsh(J.T @ J)
        return Template(feature, J, int((eigenvalues > RANK_TOLERANCE * max(eigenvalues[-1], 1e-30)).sum()))

    def jacobian(self, points: np.ndarray, index: np.ndarray) -> np.ndarray:
        """J of F(exp(-xi) P) at xi = 0: points (N, 3), index (K,) -> (K, 6) float32."""
        critical, back = np.unique(index, return_inverse=True)  # a point that sets many channels passes once
        x, on = points[critical].astype(np.float32), []
        for W, b in self.layers[:-1]:
            x = x @ W.T + b
            on.append((x > 0)[back])
            x = np.maximum(x, 0)
        row = chain(self.layers, on)
        return -np.concatenate([np.cross(points[index], row), row], 1)

    def solve(
        self,
        template: Template,
        source: np.ndarray,
        g: np.ndarray,
        iterations: int = 10,
        robust: bool = True,
        basis: np.ndarray | None = None,
    ) -> Solution:
        """Iterate from each g (S, 4, 4) on source (N, 3).

        basis: (6, d) orthonormal twists that the motion may use; None for all six. Stops early once no step of any
        start exceeds ``STOP_STEP``.
        """
        errors = []
        g = g.astype(np.float64)
        for iteration in range(iterations):
            r = self.residuals(template, source, g)
            errors.append(np.abs(r).mean(-1))
            fall = SCALE_FROM + (SCALE_TO - SCALE_FROM) * iteration / max(iterations - 1, 1)
            weight = geman_mcclure(r, fall) if robust else np.ones_like(r)
            step = weighted_step(template.J, weight, r, basis)
            g = exp(step) @ g
            if np.abs(step).max() < STOP_STEP:
                break
        errors.append(np.abs(self.residuals(template, source, g)).mean(-1))
        return Solution(g, np.array(errors), template.rank)

    def residuals(self, template: Template, source: np.ndarray, g: np.ndarray) -> np.ndarray:
        """F(g Q) - F(P): (S, K)."""
        return np.array([self(source @ T[:3, :3].T + T[:3, 3]) - template.feature for T in g])


def chain(layers: Layers, on: list[np.ndarray]) -> np.ndarray:
    """Rows of the product W_n D_(n-1) W_(n-1) ... D_1 W_1, D the layers' 0/1 masks ``on`` (..., K, width): (..., K, 3).

    Row k of the last matrix goes with the masks of channel k's own point.
    """
    row = layers[-1][0]
    for (W, _), mask in zip(reversed(layers[:-1]), reversed(on), strict=True):
        row = (row * mask) @ W
    return row


def geman_mcclure(r: np.ndarray, factor: float) -> np.ndarray:
    """(s² / (s² + r²))² with s = factor times the mean |r| of each row: (..., K) -> (..., K)."""
    s2 = np.maximum((factor * np.abs(r).mean(-1, keepdims=True)) ** 2, 1e-24)
    return (s2 / (s2 + r * r)) ** 2


def weighted_step(J: np.ndarray, weight: np.ndarray, r: np.ndarray, basis: np.ndarray | None = None) -> np.ndarray:
    """The capped step dtheta of (JᵀWJ) dtheta = JᵀW r: J (K, 6) float64, weight and r (S, K) -> (S, 6) float64."""
    products = (J[:, :, None] * J[:, None, :]).reshape(len(J), 36)
    A = (weight.astype(np.float64) @ products).reshape(-1, 6, 6)
    b = (weight * r).astype(np.float64) @ J
    return capped(constrained_step(A, b, basis), MAX_STEP)


def constrained_step(A: np.ndarray, b: np.ndarray, basis: np.ndarray | None) -> np.ndarray:
    """The step of A dtheta = b, (..., 6, 6) and (..., 6), within the span of basis (6, d).

    By eigenvectors: directions that A does not see get no step, rather than a huge one.
    """
    B = np.eye(6) if basis is None else basis
    eigenvalues, V = np.linalg.eigh(B.T @ A @ B)
    seen = eigenvalues > RANK_TOLERANCE * np.maximum(eigenvalues[..., -1:], 1e-30)
    inverse = np.where(seen, 1 / np.maximum(eigenvalues, 1e-30), 0.0)
    V = B @ V
    return (V @ (inverse[..., None] * (np.swapaxes(V, -1, -2) @ b[..., None])))[..., 0]


def capped(step: np.ndarray, size: float) -> np.ndarray:
    """The step (..., 6), shortened where its norm exceeds ``size``."""
    norm = np.linalg.norm(step, axis=-1, keepdims=True)
    return step * np.minimum(size / np.maximum(norm, 1e-30), 1.0)
