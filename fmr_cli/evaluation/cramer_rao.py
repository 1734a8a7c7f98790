"""How exact a pose can be at all where points are noisy: the Cramér-Rao bound of point-to-plane."""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.point_to_plane import linearise, normal_equations


def information(points: np.ndarray, normals: np.ndarray, variance: float) -> np.ndarray:
    """The Fisher information (6, 6) of a twist (rotation about the points' mean, shift): rad⁻² and unit⁻².

    The surface is unknown; both clouds measure it, with independent normal noise of variance σs² and σt² along each
    axis. In a piece of it so small that its normal n and J = (x × n, n) are constant lie ns points of the source and nt
    of the target. What they say of the pose is in the difference of their mean heights along n: J·ξ to first order,
    with the variance σs²/ns + σt²/nt. (Along the surface the points lie anywhere: that says nothing.) So the piece
    informs by J Jᵀ / (σs²/ns + σt²/nt), and with nt/ns alike all over, all pieces together by

        I = Σ over the source's points of J Jᵀ / (σs² + σt² ns/nt) ,

    for any size of the pieces: of two clouds of one density, J Jᵀ over the variance of the distance between two noisy
    samples. No unbiased estimate has a smaller covariance than I⁻¹ (Cramér, Rao) without knowing more of the surface,
    such as that it is made of planes whose borders are sharp.

    points: where the source's points truly lie, normals: the exact ones there, (N, 3) each; variance: σs² + σt² ns/nt.
    """
    _, J = linearise(points, points, normals, points.mean(0))
    return normal_equations(J, np.zeros(len(points)), np.full(len(points), 1 / variance))[0]


def median_rotation(information: np.ndarray) -> float:
    """The median rotation error of an estimate that reaches the bound, degrees.

    The rotation vector is normal with the covariance C; its squared length has the mean m = tr C and the variance
    v = 2 tr C². The median of the gamma distribution with these moments, by Wilson and Hilferty (1931), is
    m (1 - v / 9 m²)³.
    """
    C = np.linalg.inv(information)[:3, :3]
    mean, variance = np.trace(C), 2 * np.trace(C @ C)
    return float(np.degrees(np.sqrt(mean * (1 - variance / (9 * mean**2)) ** 3)))
