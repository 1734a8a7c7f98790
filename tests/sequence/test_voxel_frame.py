"""The way into voxel coordinates and back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.sequence.voxel_frame import VoxelFrame


def test_a_pose_moves_a_point_to_the_same_place_in_either_coordinates():
    frame = VoxelFrame(0.3, np.array([600_000.0, -20.0, 5.0]))
    T_first_scan = np.eye(4)
    T_first_scan[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    T_first_scan[:3, 3] = [4.0, 5.0, -6.0]
    points = frame.origin + np.random.default_rng(0).normal(size=(20, 3))
    T_map_scan = frame.pose_to_voxels(T_first_scan)
    by_voxels = transform_points(T_map_scan, frame.points_to_voxels(points))
    assert np.allclose(by_voxels, frame.points_to_voxels(transform_points(T_first_scan, points)), atol=1e-8)
    assert np.allclose(frame.pose_to_file(T_map_scan), T_first_scan, atol=1e-8)
