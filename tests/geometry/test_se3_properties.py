"""SE(3), whatever the motion: a group, with exp and log its chart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fmr_cli.geometry import se3

MANY = settings(derandomize=True, deadline=None, max_examples=30, database=None)

directions = arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 1e-3)
angles = st.floats(0, np.pi - 1e-3)  # at half a turn the axis has two signs
shifts = arrays(float, 3, elements=st.floats(-1e3, 1e3))


@st.composite
def twists(draw) -> np.ndarray:
    axis = draw(directions)
    return np.concatenate([draw(angles) * axis / np.linalg.norm(axis), draw(shifts)])


@MANY
@given(twists())
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=1e-8, atol=1e-8)


@MANY
@given(twists())
def test_exp_of_the_opposite_twist_is_the_inverse(xi):
    np.testing.assert_allclose(se3.exp(xi) @ se3.exp(-xi), np.eye(4), atol=1e-9)


@MANY
@given(twists(), st.floats(0, 1))
def test_a_motion_can_be_made_in_two_parts(xi, share):
    np.testing.assert_allclose(se3.exp(share * xi) @ se3.exp((1 - share) * xi), se3.exp(xi), rtol=1e-9, atol=1e-9)


@MANY
@given(twists())
def test_rotations_are_rotations(xi):
    R = se3.exp(xi)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
