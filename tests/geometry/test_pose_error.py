"""The error of a pose: exact for tiny angles and half turns, batched, and the same about any origin."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fmr_cli.geometry.pose_error import angle_between, pose_error
from fmr_cli.geometry.se3 import exp


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, math.pi - 1e-6, math.pi])
def test_the_angle_keeps_its_digits(angle: float) -> None:
    a, b = exp(np.array([[0.3, -0.2, 0.9, 1, 2, 3], [0.6 * angle, 0.0, 0.8 * angle, 0, 0, 0]]))
    assert angle_between(a[:3, :3], (a @ b)[:3, :3]) == pytest.approx(angle, abs=1e-14, rel=1e-6)


def test_the_shift_is_that_of_the_centre_in_any_frame() -> None:
    true, off = exp(np.array([0.3, -0.2, 0.9, 1, 2, 3])), exp(np.array([0, 0, math.radians(2), 0.1, 0, 0]))
    centre = np.array([5.0, 1.0, -2.0])
    degrees, shift = pose_error(np.stack([off @ true, true]), true, centre)
    np.testing.assert_allclose(degrees, [2, 0], atol=1e-6)
    np.testing.assert_allclose(shift[1], 0, atol=1e-12)
    back = np.eye(4)
    back[:3, 3] = (-100, 0, 0)
    moved = pose_error(off @ true @ back, true @ back, centre - back[:3, 3])
    np.testing.assert_allclose(moved, (degrees[0], shift[0]), atol=1e-9)
