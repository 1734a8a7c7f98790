"""Normals and surface variation of a cloud from the neighbourhoods of its points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

NORMAL_NEIGHBOURS = 16  # points, about two rings on a surface of one point a voxel
CLOSE = 1e-2  # of the squared spread of eigenvalues: the closed form's rounding then shows in the eigenvector


def neighbours(points: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray]:
    """The nearest 16 of each point, itself first: distances and rows, (M, 16) each, or fewer where there are fewer."""
    return tree.query(points, min(NORMAL_NEIGHBOURS, len(points)))


def neighbours_of_all(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``neighbours`` of points (M, 3) among themselves: small_gicp's search takes half of the time of scipy's."""
    import small_gicp

    index, squared = small_gicp.KdTree(points).batch_knn_search(points, min(NORMAL_NEIGHBOURS, len(points)))
    return np.sqrt(squared), index.astype(np.int64)


def normals_and_variation(
    points: np.ndarray, distance: np.ndarray, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each point's ``neighbours``: unit normals (M, 3), their sign undetermined; variation, reach, lean (M,) each.

    The surface variation is the smallest eigenvalue of the neighbourhood's covariance over their sum (Pauly 2002), 0 on
    a plane, 1/3 where it is round; the reach is the distance to the last of them; the lean, how far off their mean is
    as a share of it: most at a border.
    """
    x, y, z = (c[index] - c[:, None] for c in np.ascontiguousarray(points.T))
    means = [c.mean(1, keepdims=True) for c in (x, y, z)]
    for c, mean in zip((x, y, z), means, strict=True):
        c -= mean
    products = [np.einsum("ij,ij->i", a, b) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))]
    normals, least = smallest_eigenvector(*products)
    reach = np.maximum(distance[:, -1], 1e-300)
    lean = np.linalg.norm(np.hstack(means), axis=1) / reach
    return normals, least / np.maximum(sum(products[:3]), 1e-300), reach, lean


def principal_variances(
    xx: np.ndarray, yy: np.ndarray, zz: np.ndarray, xy: np.ndarray, xz: np.ndarray, yz: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The eigenvalues of symmetric 3x3 matrices by their entries (M,): (M,) each, ascending."""
    mean, p, angle = roots(xx, yy, zz, xy, xz, yz)
    least, most = mean + 2 * p * np.cos(angle + 2 * np.pi / 3), mean + 2 * p * np.cos(angle)
    return least, 3 * mean - most - least, most


def roots(
    xx: np.ndarray, yy: np.ndarray, zz: np.ndarray, xy: np.ndarray, xz: np.ndarray, yz: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean m, spread p and angle a (M,) of such matrices' eigenvalues m + 2 p cos(a + 2 pi k / 3) (Smith 1961)."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    p = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    return mean, p, np.arccos(np.clip(det / np.maximum(2 * p**3, 1e-300), -1, 1)) / 3


def smallest_eigenvector(
    xx: np.ndarray, yy: np.ndarray, zz: np.ndarray, xy: np.ndarray, xz: np.ndarray, yz: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of symmetric 3x3 matrices by their entries (M,): the unit eigenvector (M, 3) of the smallest eigenvalue (M,).

    In closed form, several times faster than LAPACK on matrices this small, which still solves the few where two
    eigenvalues are too close for it.
    """
    mean, p, angle = roots(xx, yy, zz, xy, xz, yz)
    least = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    # The eigenvector is orthogonal to the rows of the matrix less its eigenvalue: the longest of their cross products.
    a, b, c = xx - least, yy - least, zz - least
    crosses = np.array([
        [xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy],
        [xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz],
        [b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz],
    ])  # fmt: skip
    length2 = (crosses * crosses).sum(1)
    best = length2.argmax(0)
    rows = np.arange(len(best))
    normals = crosses[best, :, rows]
    length = np.sqrt(length2[best, rows])
    normals /= np.maximum(length, 1e-300)[:, None]
    close = np.flatnonzero(length < CLOSE * p * p)
    if len(close):
        C = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[..., close].transpose(2, 0, 1)
        values, vectors = np.linalg.eigh(C)
        normals[close], least[close] = vectors[..., 0], values[:, 0]
    return normals, np.maximum(least, 0)
