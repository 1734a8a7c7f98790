"""The largest corner of a surface, and what lies on none of its planes.

Three planes that meet in a point fix a pose, and fit wherever three planes meet at the same angles: the corner of a
room or of a box fits any other corner, in several ways. What tells corners apart lies on none of the three.
"""

from __future__ import annotations

import numpy as np

PLANES = 3
POINTS, SEEDS = 1000, 60  # points that are looked at, and those of them whose tangent planes are tried
ALONG = 0.85  # |cosine| between a point's normal and its plane's: noise turns normals by 20 deg, 30 deg are a bend
OFF = 1.5  # voxel edges that a point of a plane may lie off: beside an edge, voxels average both sides
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
        seeds = np.flatnonzero(np.linalg.norm(n @ across, axis=1) > ACROSS)[:SEEDS]  # they are in random order
        if len(seeds) < PLANES:
            break
        off = np.abs(x @ n[seeds].T - np.einsum("ni,ni->n", x[seeds], n[seeds]))
        along = (off < OFF * edge) & (np.abs(n @ n[seeds].T) > ALONG)
        plane = x[along[:, along.sum(0).argmax()]]
        middle = plane.mean(0)
        normal = np.linalg.eigh((plane - middle).T @ (plane - middle))[1][:, 0]
        left = np.abs((x - middle) @ normal) >= OFF * edge
        x, n = x[left], n[left]
        new = across @ normal
        across = across - np.outer(new, new) / max(float(new @ new), 1e-12)
    return len(x) / max(len(some), 1)
