"""The largest corner of a surface, and what lies on none of its planes.

Three planes that meet in a point fix a pose, and fit wherever three planes meet at the same angles: the corner of a
room or of a box fits any other corner, in several ways. What tells corners apart lies on none of the three.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.kernels import NORMAL

PLANES = 3
POINTS, SEEDS = 1000, 60  # points that are looked at, and those of them whose tangent planes are tried
ALONG = 0.85  # |cosine| between a point's normal and its plane's: noise turns normals by 20 deg, 30 deg are a bend
OFF = 1.5  # voxel edges that a point of a plane may lie off at most: beside an edge, voxels average both sides
# At least, and times the scatter of the layer of twice that width that most of the plane's points lie in: neither the
# noise of a wall nor its windows' recess, which is none.
LEAST_OFF, SIGMAS = 0.5, 4.0
ACROSS = 0.5  # of a normal, the least share outside the span of the former planes': parallel planes make no corner


def share_beyond_corner(points: np.ndarray, normals: np.ndarray, edge: float, rng: np.random.Generator) -> float:
    """The share of points (N, 3), normals (N, 3) of either sign, on no plane of their largest corner; 0 of none.

    Greedy: of SEEDS tangent planes the one that most points lie along, fitted to them; then, of what is left, the
    largest one across it, and the largest one across both.
    """
    some = rng.permutation(len(points))[:POINTS]
    x, n = points[some], normals[some]
    across = np.eye(3)  # onto what no plane so far has a normal along
    for _ in range(PLANES):
        rest = n @ across
        seeds = np.flatnonzero(np.einsum("ni,ni->n", rest, rest) > ACROSS**2)[:SEEDS]  # they are in random order
        if len(seeds) < PLANES:
            break
        # A row a seed, whose points then lie one after the other
        off = n[seeds] @ x.T
        off -= np.einsum("ni,ni->n", x[seeds], n[seeds])[:, None]
        cosine = n[seeds] @ n.T
        along = (np.abs(off, out=off) < OFF * edge) & (np.abs(cosine, out=cosine) > ALONG)
        normal, on = plane(x, n, along[np.count_nonzero(along, axis=1).argmax()], edge)
        x, n = x[~on], n[~on]
        new = across @ normal
        across = across - np.outer(new, new) / max(float(new @ new), 1e-12)
    return len(x) / max(len(some), 1)


def plane(points: np.ndarray, normals: np.ndarray, about: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """The plane through points ``about`` (N,), as thick as its own points scatter: its normal (3,), what lies on it."""
    for _ in range(2):  # the second time without what stands out from it
        some = points[about]
        middle = some.mean(0)
        some -= middle
        normal = np.linalg.eigh(some.T @ some)[1][:, 0]
        height = (points - middle) @ normal
        alike = (np.abs(height) < OFF * edge) & (np.abs(normals @ normal) > ALONG)
        layer = thickest(height[alike] if alike.any() else np.zeros(1), 2 * LEAST_OFF * edge)
        level = layer[len(layer) // 2]
        off = np.sort(np.abs(layer - level))
        sigma = NORMAL * (off[(len(off) - 1) // 2] + off[len(off) // 2]) / 2
        on = np.abs(height - level) < np.clip(SIGMAS * sigma, LEAST_OFF * edge, OFF * edge)
        about = alike & on if (alike & on).sum() >= PLANES else about
    return normal, on


def thickest(heights: np.ndarray, width: float) -> np.ndarray:
    """Those of heights (N,) in the window of ``width`` that has most, in order: of a wall and its windows, the wall."""
    heights = np.sort(heights)
    ends = heights.searchsorted(heights + width, side="right")
    first = int((ends - np.arange(len(heights))).argmax())
    return heights[first : ends[first]]
