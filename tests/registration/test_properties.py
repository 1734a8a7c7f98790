"""What must hold of `align` wherever the scans lie and whatever their unit: equivariance, and the inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fmr_cli import Options, PointCloud, align
from fmr_cli.cloud import transform_points
from fmr_cli.geometry.pose_error import pose_error

# Voxel grids lie along the axes of the file, so that a turned cloud is another sample of its surface: poses agree to
# what two samplings of the room leave over (the voxel is about 0.1 m), and exactly only where the unit alone changes.
DEGREES, SHIFT = 0.3, 0.03  # deg, m
FEW = settings(derandomize=True, deadline=None, max_examples=4, database=None)


@st.composite
def motions(draw) -> np.ndarray:
    """Any rotation, and a shift of up to a kilometre."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=draw(st.integers(0, 1000))).as_matrix()
    T[:3, 3] = [draw(st.floats(-1000, 1000)) for _ in range(3)]
    return T


@pytest.fixture(scope="module")
def clouds(room_scans) -> tuple[np.ndarray, np.ndarray]:
    return room_scans[0][:6000], room_scans[1][:6000]


def register(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    found = align(PointCloud(source), PointCloud(target), Options(), threads=1)
    assert found.status == "aligned"
    return found.T_target_source


@pytest.fixture(scope="module")
def plain(clouds) -> np.ndarray:
    """T_target_source of the scans as they are: nearly the identity, as both are in the room's frame."""
    T = register(*clouds)
    assert pose_error(T, np.eye(4), clouds[0].mean(0)) == pytest.approx((0, 0), abs=0.1)
    return T


@FEW
@given(X=motions(), Y=motions())
def test_the_pose_follows_a_motion_of_either_cloud(clouds, plain, X, Y):
    source, target = clouds
    found = register(transform_points(X, source), transform_points(Y, target))
    degrees, shift = pose_error(np.linalg.inv(Y) @ found @ X, plain, source.mean(0))
    assert degrees < DEGREES
    assert shift < SHIFT


@FEW
@example(exponent=-6.0)
@given(exponent=st.floats(-6, 6))
def test_the_pose_follows_a_change_of_unit(clouds, plain, exponent):
    unit = 10.0**exponent
    found = register(unit * clouds[0], unit * clouds[1])
    found[:3, 3] /= unit
    degrees, shift = pose_error(found, plain, clouds[0].mean(0))
    assert degrees < 0.01
    assert shift < 0.001


@FEW
@given(X=motions())
def test_target_onto_source_is_the_inverse(clouds, X):
    source, target = transform_points(X, clouds[0]), clouds[1]
    there, back = register(source, target), register(target, source)
    degrees, shift = pose_error(back @ there, np.eye(4), source.mean(0))
    assert degrees < DEGREES
    assert shift < SHIFT
