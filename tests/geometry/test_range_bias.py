"""What a range bias adds to a covariance: surfaces that face each other show it, those of one corner do not."""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.observability import outwards, range_bias
from fmr_cli.geometry.point_to_plane import linearise

NOISE = 0.01  # of each residual, own unit


def added(faces: list[tuple[int, float]], bias: float) -> np.ndarray:
    """The covariance (6, 6) for a sensor amid faces (axis, side) of a box of two units, each one observation."""
    rng = np.random.default_rng(0)
    points, normals = [], []
    for axis, side in faces:
        face = rng.uniform(-1, 1, (500, 3))
        face[:, axis] = side
        points.append(face)
        normals.append(np.tile(side * np.eye(3)[axis], (500, 1)))
    x, n = np.concatenate(points), np.concatenate(normals)
    outward = outwards(x, n, np.zeros(3))
    r, J = linearise(x, x, n, np.zeros(3))
    r = r + rng.normal(0, NOISE, len(r)) + bias * outward
    w = np.ones(len(r))
    sigma = np.full(2, NOISE)
    return range_bias(J, np.stack([outward, -outward]), w, r, np.linalg.inv(J @ J.T), NOISE**2, sigma, 500.0)


CORNER = [(0, 1.0), (1, 1.0), (2, 1.0)]
BOX = [(axis, side) for axis in range(3) for side in (-1.0, 1.0)]


def test_a_closed_box_moves_by_no_range_bias() -> None:
    assert np.sqrt(np.diag(added(BOX, 5 * NOISE))).max() < 0.3 * NOISE


def test_in_a_corner_a_range_bias_is_a_shift_that_no_residual_tells() -> None:
    # Each scan's bias, of one sigma, moves a face by the mean of n·u over it, some 0.8; those of two add up by squares.
    shift = np.sqrt(np.diag(added(CORNER, 0.0))[3:])
    assert np.all((shift > 0.6 * NOISE) & (shift < 2.5 * NOISE))
