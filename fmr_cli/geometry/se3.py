"""SE(3): twists xi = (omega, v), rotation first, and their 4x4 matrices. Numpy or torch, batched, differentiable.

Every coefficient is a power series near zero angle, so values and gradients stay exact where sin(a)/a would be 0/0.
"""

from __future__ import annotations

from array_api_compat import device

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.arrays import Array, namespace

SMALL = 1e-4  # rad²: below this squared angle the series, to its sixth power of the angle, is exact to float64 rounding

transform = transform_points  # R x + t for numpy and torch, batch dimensions broadcast


def hat(omega: Array) -> Array:
    """(..., 3) -> (..., 3, 3): the matrix of the cross product, hat(w) x = w × x."""
    xp = namespace(omega)
    x, y, z = omega[..., 0], omega[..., 1], omega[..., 2]
    o = xp.zeros_like(x)
    return xp.reshape(xp.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1), (*omega.shape[:-1], 3, 3))


def coefficients(angle2: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1 - cos(a))/a², (a - sin(a))/a³ as functions of a² in rad²."""
    xp = namespace(angle2)
    t, small = angle2, angle2 < SMALL
    safe = xp.where(small, xp.ones_like(t), t)  # keeps NaN out of the gradient of the other branch
    a = xp.sqrt(safe)
    sinc = xp.where(small, 1 - t / 6 + t**2 / 120 - t**3 / 5040, xp.sin(a) / a)
    versine = xp.where(small, 0.5 - t / 24 + t**2 / 720 - t**3 / 40320, 2 * (xp.sin(a / 2) / a) ** 2)
    cubic = xp.where(small, 1 / 6 - t / 120 + t**2 / 5040 - t**3 / 362880, (a - xp.sin(a)) / (safe * a))
    return sinc, versine, cubic


def exp(xi: Array) -> Array:
    """(..., 6) twist -> (..., 4, 4): R = I + A w^ + B w^², t = (I + B w^ + C w^²) v."""
    xp = namespace(xi)
    omega, v = xi[..., :3], xi[..., 3:]
    A, B, C = coefficients(xp.sum(omega * omega, axis=-1)[..., None, None])  # each (..., 1, 1)
    W = hat(omega)
    W2 = W @ W
    identity = xp.eye(3, dtype=xi.dtype, device=device(xi))
    R = identity + A * W + B * W2
    t = (identity + B * W + C * W2) @ v[..., None]
    bottom = xp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=xi.dtype, device=device(xi))
    bottom = xp.broadcast_to(bottom, (*xi.shape[:-1], 1, 4))
    return xp.concat([xp.concat([R, t], axis=-1), bottom], axis=-2)


def log(T: Array) -> Array:
    """(..., 4, 4) -> (..., 6) twist, the inverse of ``exp`` for angles in [0, pi].

    The rotation goes by its unit quaternion, which keeps the axis well defined up to and at pi.
    """
    xp = namespace(T)
    omega = 2 * half_angle_axis(quaternion(T[..., :3, :3]))
    angle2 = xp.sum(omega * omega, axis=-1)[..., None, None]  # (..., 1, 1)
    A, B, _ = coefficients(angle2)
    small = angle2 < SMALL
    safe = xp.where(small, xp.ones_like(angle2), angle2)
    # V^-1 = I - w^/2 + D w^², D = (1 - A / (2 B)) / a²
    D = xp.where(small, 1 / 12 + angle2 / 720 + angle2**2 / 30240, (1 - A / (2 * B)) / safe)
    W = hat(omega)
    identity = xp.eye(3, dtype=T.dtype, device=device(T))
    v = (identity - W / 2 + D * (W @ W)) @ T[..., :3, 3:]
    return xp.concat([omega, v[..., 0]], axis=-1)


def adjoint(T: Array) -> Array:
    """(..., 4, 4) -> (..., 6, 6): A with T exp(xi) = exp(A xi) T; a twist in T's source axes as one in its target's."""
    xp = namespace(T)
    R = T[..., :3, :3]
    top = xp.concat([R, xp.zeros_like(R)], axis=-1)
    return xp.concat([top, xp.concat([hat(T[..., :3, 3]) @ R, R], axis=-1)], axis=-2)


def half_angle_axis(q: Array) -> Array:
    """(..., 4) unit quaternion (w >= 0) -> (..., 3): its axis times half its angle."""
    xp = namespace(q)
    w, xyz = q[..., :1], q[..., 1:]
    s2 = xp.sum(xyz * xyz, axis=-1, keepdims=True)
    small = s2 < SMALL
    safe = xp.sqrt(xp.where(small, xp.ones_like(s2), s2))
    series = 1 + s2 / 6 + 3 * s2**2 / 40 + 15 * s2**3 / 336  # asin(s) / s
    return xp.where(small, series, xp.atan2(safe, w) / safe) * xyz


def quaternion(R: Array) -> Array:
    """(..., 3, 3) rotation -> (..., 4) unit quaternion (w, x, y, z), w >= 0 (Shepperd: the largest of four forms)."""
    xp, m = namespace(R), R
    a, b, c = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    d: Array = xp.stack([1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c], axis=-1)  # 4 q_i²
    w, x, y, z = d[..., 0], d[..., 1], d[..., 2], d[..., 3]
    products = xp.stack([w, wx, wy, wz, wx, x, xy, xz, wy, xy, y, yz, wz, xz, yz, z], axis=-1)
    rows = xp.reshape(products, (*d.shape, 4))  # row i is 4 q_i q
    best = xp.broadcast_to(xp.argmax(d, axis=-1)[..., None, None], (*d.shape[:-1], 1, 4))
    q = xp.take_along_axis(rows, best, axis=-2)[..., 0, :]
    q = q / xp.linalg.vector_norm(q, axis=-1, keepdims=True)
    return xp.where(q[..., :1] < 0, -q, q)


def from_quaternion(q: Array) -> Array:
    """(..., 4) unit quaternion (w, x, y, z) -> (..., 3, 3) rotation."""
    xp = namespace(q)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return xp.reshape(xp.stack(entries, axis=-1), (*q.shape[:-1], 3, 3))
