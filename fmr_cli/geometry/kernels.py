"""Robust kernels: what a residual is worth in a least squares problem that is solved again and again (IRLS)."""

from __future__ import annotations

from fmr_cli.geometry.arrays import Array


def geman_mcclure(squared: Array, scale2: Array | float) -> Array:
    """The weight (s² / (s² + e²))² of Geman and McClure (1985) for squared residuals e² and the squared scale s².

    1 at no residual, 1/4 at the scale, and it falls with the fourth power beyond: what lies far off has no say.
    """
    return (scale2 / (scale2 + squared)) ** 2
