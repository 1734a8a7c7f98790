"""The largest planes of a surface, and what lies on none of them.

Three planes fix a pose, and fit wherever three planes meet at the same angles: the corner of a room or of a box fits
any other corner, in several ways. What tells corners apart lies on none of the three.
"""

from __future__ import annotations

import numpy as np

PLANES = 3
POINTS, SEEDS = 1000, 60  # points that are looked at, and those of them whose tangent planes are tried
ALONG = 0.85  # |cosine| between a point's normal and its plane's: noise turns normals by 20 deg, 30 deg are a bend
OFF = 1.5  # voxel edges that a point of a plane may lie off: beside an edge, voxels average both sides


def share_beyond_planes(points: np.ndarray, normals: np.ndarray, edge: float, rng: np.random.Generator) -> float:
    """The share of points (N, 3), normals (N, 3) of either sign, on none of their PLANES largest planes; 0 of none.

    Greedy: of SEEDS tangent planes the one that most points lie along, fitted to them, then the next of what is left.
    """
    some = rng.permutation(len(points))[:POINTS]
    x, n = points[some], normals[some]
    for _ in range(PLANES):
        if len(x) < PLANES:
            break
        seeds = slice(0, SEEDS)  # they are in random order
        off = np.abs(x @ n[seeds].T - np.einsum("ni,ni->n", x[seeds], n[seeds]))
        along = (off < OFF * edge) & (np.abs(n @ n[seeds].T) > ALONG)
        plane = x[along[:, along.sum(0).argmax()]]
        middle = plane.mean(0)
        normal = np.linalg.eigh((plane - middle).T @ (plane - middle))[1][:, 0]
        left = np.abs((x - middle) @ normal) >= OFF * edge
        x, n = x[left], n[left]
    return len(x) / max(len(some), 1)
