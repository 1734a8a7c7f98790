"""Points of a scan that are no surface: what a sensor writes where it saw nothing, and points far from all others.

They carry no pose, and would set means, extents and voxel edges. Everything here is told by the points alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmr_cli.geometry.sampling import distinct

REPEATED = 20  # times, and REPEATED_SHARE of the points: one and the same coordinate so often is a sensor's "nothing"
REPEATED_SHARE = 1e-3
FAR = 50.0  # times the distance that 90 % of the points keep to the median: scanners reach 5 to 20 times that
FEW = 1e-2  # of the points may be far; what has more is a scene of two scales
SHELL = 2e-3  # of its radius: how thin the sphere is on which a sensor puts what lies beyond its range
SHELL_SHARE = 5e-3  # of the points that lie on it, at least
SHELL_GAP = 1.05  # times the distance of nearly all other points: the sphere encloses the scene
SAMPLE = 10_000  # points that are looked at to find strays, of the many that may be
SHELL_OUTER = (0.4, 0.05)  # shares of the points, the outermost, among which a shell is sought
SHELL_DRAWS, SHELL_SAMPLE = 12, 600  # spheres tried, through 4 of so many of them each
LEAST = 200  # points, fewer of which show no shell


@dataclass(frozen=True)
class Strays:
    """keep: (N,) which points may be surface. reasons: how many were set aside, by why, in words."""

    keep: np.ndarray
    reasons: dict[str, int]


def strays(points: np.ndarray, rng: np.random.Generator) -> Strays:
    """Tell the strays of points (N, 3), finite, in any unit."""
    keep, reasons = np.ones(len(points), bool), {}
    for why, found in (("at one and the same place", repeated), ("far from all others", far)):
        stray = found(points)
        if stray.any() and not stray.all():
            reasons[why], keep = int((keep & stray).sum()), keep & ~stray
    stray = on_a_shell(points[keep] if reasons else points, rng)
    if stray.any():
        reasons["at the sensor's maximum range"], keep[np.flatnonzero(keep)[stray]] = int(stray.sum()), False
    return Strays(keep, reasons)


def repeated(points: np.ndarray) -> np.ndarray:
    """(N,) which points have the coordinates that a sensor gives to what it did not see, often the origin."""
    some = points[:: max(len(points) // 1000, 1)]
    if len(distinct(some)) == len(some):  # as of most scans, and a tenth of the time of sorting them
        return np.zeros(len(points), bool)
    _, first, count = np.unique(some, axis=0, return_index=True, return_counts=True)
    candidates = some[first[count > 1]]
    stray = np.zeros(len(points), bool)
    for place in candidates[:8]:
        same = (points == place).all(1)
        if same.sum() >= max(REPEATED, REPEATED_SHARE * len(points)):
            stray |= same
    return stray


def far(points: np.ndarray) -> np.ndarray:
    """(N,) which points lie far beyond nearly all others."""
    some = points[:: max(len(points) // SAMPLE, 1)]
    middle = np.median(some, axis=0)
    limit = FAR * np.quantile(np.abs(some - middle).max(1), 0.9)
    none = np.zeros(len(points), bool)
    if max(max(x.max() - c, c - x.min()) for x, c in zip(points.T, middle, strict=True)) <= limit:
        return none  # as most clouds, without an array of their size
    stray = np.maximum.reduce([np.abs(x - c) for x, c in zip(points.T, middle, strict=True)]) > limit
    return stray if limit > 0 and stray.sum() <= max(FEW * len(points), 1) else none


def on_a_shell(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(N,) which points lie on a thin sphere that encloses all others: no-returns written at the maximum range."""
    none = np.zeros(len(points), bool)
    if len(points) < LEAST:
        return none
    some = points[:: max(len(points) // SAMPLE, 1)]
    apart = length(some - np.median(some, axis=0))
    for share in SHELL_OUTER:
        outer = some[apart >= np.quantile(apart, 1 - share)]
        outer = outer[rng.permutation(len(outer))[:SHELL_SAMPLE]]
        drawn = np.array([rng.choice(len(outer), 4, replace=False) for _ in range(SHELL_DRAWS)])
        near = on(outer, *spheres(outer[drawn]), 2 * SHELL)
        near = near[near.sum(1).argmax()]
        if near.sum() < len(outer) / 3:
            continue
        centre, radius = fitted_sphere(outer[near])
        if length(some - centre).max() >= (1 + 2 * SHELL) * radius:
            continue  # as of most clouds, by the few points: others lie outside
        distance = length(points - centre) / radius
        shell = np.abs(distance - 1) < SHELL
        if not SHELL_SHARE * len(points) <= shell.sum() <= len(points) * (1 - 1 / 20):
            continue
        rest = distance[~shell]
        if np.quantile(rest, 0.99) < 1 / SHELL_GAP and rest.max() < 1 + 2 * SHELL:
            return shell
    return none


def on(points: np.ndarray, centre: np.ndarray, radius: np.ndarray, tolerance: float) -> np.ndarray:
    """Which points (N, 3) lie on which spheres, centre (B, 3), radius (B,), to within a share of that: (B, N)."""
    return np.abs(length(points - centre[:, None]) - radius[:, None]) < tolerance * radius[:, None]


def length(x: np.ndarray) -> np.ndarray:
    """|x| of vectors (..., 3): (...)."""
    return np.sqrt(np.einsum("...i,...i->...", x, x))


def fitted_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of the sphere next to points (N, 3): least squares on |x|² = 2 c·x + (r² - |c|²)."""
    middle = points.mean(0)
    x = points - middle
    c = np.linalg.lstsq(np.column_stack([2 * x, np.ones(len(x))]), (x * x).sum(1), rcond=None)[0]
    return c[:3] + middle, float(np.sqrt(max(c[3] + c[:3] @ c[:3], 0.0)))


def spheres(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (B, 3) and radii (B,) of the spheres through points (B, 4, 3); 0 where four lie in one plane."""
    first, others = points[:, 0], points[:, 1:]
    A = 2 * (others - first[:, None])
    flat = np.abs(np.linalg.det(A)) <= 1e-9 * length(A).prod(1)
    A[flat] = np.eye(3)
    squares = (others**2).sum(2) - (first**2).sum(1)[:, None]
    centre = np.where(flat[:, None], first, np.linalg.solve(A, squares[..., None])[..., 0])
    return centre, np.where(flat, 0.0, length(first - centre))
