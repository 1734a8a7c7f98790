"""Places that leave a scan's pose open, ray-cast with exact truth: a tunnel, a corridor, a wall, the open; metres.

A thing is a function of the eye (3,) and unit rays (N, 3), and gives the distance to it, infinite where it is missed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

Thing = Callable[[np.ndarray, np.ndarray], np.ndarray]
NEAR = 1e-6


def spinning(beams: int = 32, columns: int = 600, low: float = -25.0, high: float = 15.0) -> np.ndarray:
    """Unit rays (N, 3) of a spinning scanner, degrees of elevation from low to high."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(low, high, beams)), np.arange(columns) * 2 * np.pi / columns
    )
    e, a = elevation.ravel(), azimuth.ravel()
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)


def camera(width: int = 128, height: int = 96, view: float = 58.0) -> np.ndarray:
    """Unit rays (N, 3) of a depth camera that looks along x; view: degrees across."""
    u = np.tan(np.radians(view / 2)) * np.linspace(-1, 1, width)
    across, up = np.meshgrid(u, u[-1] * height / width * np.linspace(-1, 1, height))
    rays = np.stack([np.ones(across.size), -across.ravel(), -up.ravel()], 1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def wall(axis: int, at: float, where: Callable[[np.ndarray], np.ndarray] | None = None) -> Thing:
    """The plane whose coordinate ``axis`` is ``at``, in so far as ``where`` says of its points (N, 3)."""

    def hit(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - eye[axis]) / rays[:, axis]
        t = np.where(t > NEAR, t, np.inf)
        if where is None:
            return t
        return np.where(where(eye + rays * np.where(np.isfinite(t), t, 0)[:, None]), t, np.inf)

    return hit


def block(low: tuple[float, ...], high: tuple[float, ...]) -> Thing:
    """A box by two corners, seen from outside."""

    def hit(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (np.array(low) - eye) / rays, (np.array(high) - eye) / rays
        enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        return np.where((enter < leave) & (enter > NEAR), enter, np.inf)

    return hit


def tunnel(radius: float, begin: float = -np.inf, end: float = np.inf) -> Thing:
    """The inside of a round tube along x."""

    def hit(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        a, b = (rays[:, 1:] ** 2).sum(1), rays[:, 1:] @ eye[1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-b + np.sqrt(b * b - a * (eye[1:] @ eye[1:] - radius**2))) / a
        t = np.where(t > NEAR, t, np.inf)
        x = eye[0] + rays[:, 0] * np.where(np.isfinite(t), t, 0)
        return np.where((x > begin) & (x < end), t, np.inf)

    return hit


def placed(x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """T_world_sensor (4, 4); yaw in degrees."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
    T[:3, 3] = x, y, z
    return T


def seen(
    things: list[Thing], T_world_sensor: np.ndarray, rays: np.ndarray, rng: np.random.Generator, noise: float,
    reach: float,
) -> np.ndarray:  # fmt: skip
    """(N, 3) points in the sensor's frame; noise along the ray."""
    turned = rays @ T_world_sensor[:3, :3].T
    distance = np.min([thing(T_world_sensor[:3, 3], turned) for thing in things], axis=0)
    hit = distance < reach
    return rays[hit] * (distance[hit] + rng.normal(0, noise, hit.sum()))[:, None]
