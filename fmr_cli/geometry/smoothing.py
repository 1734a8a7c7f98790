"""How noisy a cloud is, told by its own neighbourhoods, and its points put onto the planes that these show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.geometry.normals import smallest_eigenvector

NEAR = 10  # neighbours that tell noise from shape: so few lie on a plane, whatever the surface
PROBES = 500  # points at which that is looked at


def local_planes(points: np.ndarray, tree: cKDTree, neighbours: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares planes through the nearest ``neighbours`` of points (N, 3) among those of a tree.

    Returns the points put onto their planes (N, 3), unit normals (N, 3), and the planes' roughness (N,): the deviation
    of the neighbours from it, over the distance of the farthest. That is noise over the neighbourhood's size, where
    there is noise, and small on any smooth surface.
    """
    moved, normals, deviation, radius = planes_through(points, tree, neighbours)
    return moved, normals, deviation / radius


def planes_through(points: np.ndarray, tree: cKDTree, neighbours: int) -> tuple[np.ndarray, ...]:
    """``local_planes``, with the deviation (N,) and the distance of the farthest neighbour (N,) apart, own unit."""
    return planes_of(points, tree.data, *tree.query(points, min(neighbours, tree.n)))


def planes_of(points: np.ndarray, data: np.ndarray, distance: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, ...]:
    """``planes_through`` with neighbours that are known: their distances (N, k), nearest first, and rows of data."""
    x, y, z = np.moveaxis(data[index], -1, 0)
    middle = np.stack([x.mean(1), y.mean(1), z.mean(1)], 1)
    x, y, z = (c - m[:, None] for c, m in zip((x, y, z), middle.T, strict=True))
    products = [np.einsum("ij,ij->i", a, b) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))]
    normals, least = smallest_eigenvector(*products)
    deviation = np.sqrt(np.maximum(least, 0) / max(index.shape[1] - 3, 1))
    off = np.einsum("ij,ij->i", points - middle, normals)
    return points - off[:, None] * normals, normals, deviation, np.maximum(distance[:, -1], 1e-300)


@dataclass(frozen=True)
class Roughness:
    """How rough the small neighbourhoods of a cloud are, and whether that is noise: medians over some of them.

    share: the roughness by ``local_planes``: 0.05 is clean, 0.2 noisy, or so sparse that 10 neighbours show the shape.
    growth: by what factor the deviation grows from these to wide neighbourhoods: noise is as large over any (up to the
    root of the numbers' ratio, where it is larger than the neighbourhoods), while at a crease the deviation grows as
    their radius, on a bend as its square. noise: the small neighbourhoods' deviation, own unit, less what a crease has
    of it that makes it grow so much: nothing of a surface that is bent and clean.
    """

    share: float
    growth: float
    noise: float


def roughness(points: np.ndarray, wide: int) -> Roughness:
    """Of points (N, 3); wide: neighbours of a wide neighbourhood."""
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    some = points[:: max(len(points) // PROBES, 1)]
    # The nearest of a wide neighbourhood are the small one.
    distance, index = tree.query(some, min(wide, tree.n))
    near, radius = planes_of(some, points, distance[:, :NEAR], index[:, :NEAR])[2:]
    share, deviation = float(np.median(near / radius)), float(np.median(near))
    if wide >= tree.n:
        return Roughness(share, np.inf, 0.0)
    far = planes_of(some, points, distance, index)[2]
    growth = float(np.median(far / np.maximum(near, 1e-300)))
    wider = wide / NEAR  # in area; with noise n and a crease's deviation c: near² = n² + c², far² = n² + wider c²
    # A product: growth is endless where neighbours lie together, and the square of that an OverflowError.
    return Roughness(share, growth, deviation * float(np.sqrt(np.clip((wider - growth * growth) / (wider - 1), 0, 1))))
