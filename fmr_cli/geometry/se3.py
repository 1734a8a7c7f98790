"""SE(3): twists xi = (omega, v), rotation first, and their 4x4 matrices. Batched over leading dims, differentiable.

Every coefficient is a power series near zero angle, so values and gradients stay exact where sin(a)/a would be 0/0.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Below this squared angle the series (to sixth order in the angle) is exact to float64 rounding.
_SMALL = 1e-4


def hat(omega: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3): the matrix of the cross product, hat(w) x = w × x."""
    x, y, z = omega.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*omega.shape[:-1], 3, 3)


def _coefficients(angle2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos(a))/a², (a - sin(a))/a³ as functions of a²."""
    small = angle2 < _SMALL
    safe = torch.where(small, torch.ones_like(angle2), angle2)  # keeps NaN out of the gradient of the other branch
    a = safe.sqrt()
    t = angle2
    sinc = torch.where(small, 1 - t / 6 + t**2 / 120 - t**3 / 5040, a.sin() / a)
    versine = torch.where(small, 0.5 - t / 24 + t**2 / 720 - t**3 / 40320, 2 * ((a / 2).sin() / a) ** 2)
    cubic = torch.where(small, 1 / 6 - t / 120 + t**2 / 5040 - t**3 / 362880, (a - a.sin()) / (safe * a))
    return sinc, versine, cubic


def exp(xi: Tensor) -> Tensor:
    """(..., 6) twist -> (..., 4, 4): R = I + A w^ + B w^², t = (I + B w^ + C w^²) v."""
    omega, v = xi[..., :3], xi[..., 3:]
    A, B, C = (c[..., None, None] for c in _coefficients((omega * omega).sum(-1)))
    W = hat(omega)
    W2 = W @ W
    identity = torch.eye(3, dtype=xi.dtype, device=xi.device)
    R = identity + A * W + B * W2
    t = (identity + B * W + C * W2) @ v[..., None]
    bottom = torch.tensor([0, 0, 0, 1], dtype=xi.dtype, device=xi.device).expand(*xi.shape[:-1], 1, 4)
    return torch.cat([torch.cat([R, t], -1), bottom], -2)


def log(T: Tensor) -> Tensor:
    """(..., 4, 4) -> (..., 6) twist, the inverse of ``exp`` for angles in [0, pi].

    The rotation goes by its unit quaternion, which keeps the axis well defined up to and at pi.
    """
    omega = 2 * _half_angle_axis(quaternion(T[..., :3, :3]))
    angle2 = (omega * omega).sum(-1)
    A, B, _ = _coefficients(angle2)
    small = angle2 < _SMALL
    safe = torch.where(small, torch.ones_like(angle2), angle2)
    # V^-1 = I - w^/2 + D w^², D = (1 - A / (2 B)) / a²
    D = torch.where(small, 1 / 12 + angle2 / 720 + angle2**2 / 30240, (1 - A / (2 * B)) / safe)
    W = hat(omega)
    identity = torch.eye(3, dtype=T.dtype, device=T.device)
    v = (identity - W / 2 + D[..., None, None] * (W @ W)) @ T[..., :3, 3:]
    return torch.cat([omega, v[..., 0]], -1)


def _half_angle_axis(q: Tensor) -> Tensor:
    """(..., 4) unit quaternion (w >= 0) -> (..., 3): its axis times half its angle."""
    w, xyz = q[..., 0], q[..., 1:]
    s2 = (xyz * xyz).sum(-1)
    small = s2 < _SMALL
    safe = torch.where(small, torch.ones_like(s2), s2).sqrt()
    series = 1 + s2 / 6 + 3 * s2**2 / 40 + 15 * s2**3 / 336  # asin(s) / s
    return torch.where(small, series, torch.atan2(safe, w) / safe)[..., None] * xyz


def quaternion(R: Tensor) -> Tensor:
    """(..., 3, 3) rotation -> (..., 4) unit quaternion (w, x, y, z), w >= 0 (Shepperd: the largest of four forms)."""
    m = R
    d = torch.stack(
        [
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
        ],
        -1,
    )  # 4 q_i²
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = torch.stack(
        [
            torch.stack([d[..., 0], wx, wy, wz], -1),
            torch.stack([wx, d[..., 1], xy, xz], -1),
            torch.stack([wy, xy, d[..., 2], yz], -1),
            torch.stack([wz, xz, yz, d[..., 3]], -1),
        ],
        -2,
    )  # row i is 4 q_i q
    best = d.argmax(-1)[..., None, None].expand(*d.shape[:-1], 1, 4)
    q = rows.gather(-2, best)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def from_quaternion(q: Tensor) -> Tensor:
    """(..., 4) unit quaternion (w, x, y, z) -> (..., 3, 3) rotation."""
    w, x, y, z = q.unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).reshape(*q.shape[:-1], 3, 3)  # fmt: skip


def transform(T: Tensor, points: Tensor) -> Tensor:
    """R x + t: T (..., 4, 4), points (..., N, 3), batch dimensions broadcast."""
    return points @ T[..., :3, :3].transpose(-1, -2) + T[..., None, :3, 3]
