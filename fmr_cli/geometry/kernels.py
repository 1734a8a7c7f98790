"""Robust kernels: what a residual is worth in a least squares problem that is solved again and again (IRLS)."""

from __future__ import annotations

from fmr_cli.geometry.arrays import Array

NORMAL = 1.4826  # standard deviations of a normal distribution in a median absolute deviation


def geman_mcclure(squared: Array, scale2: Array | float) -> Array:
    """The weight (s² / (s² + e²))² of Geman and McClure (1985) for squared residuals e² and the squared scale s².

    1 at no residual, 1/4 at the scale, and it falls with the fourth power beyond: what lies far off has no say.
    """
    return (scale2 / (scale2 + squared)) ** 2


def geman_mcclure_slope(squared: Array, scale2: Array | float) -> Array:
    """The derivative of the weighted residual w(e) e by e, (1 - 3 u) / (1 + u)³ with u = e² / s².

    How much a residual's pull changes as it grows: less than the weight, and negative from 0.58 scales on, where the
    pull falls.
    """
    u = squared / scale2
    return (1 - 3 * u) / (1 + u) ** 3
