"""Deskewing: what a moving scanner saw, as seen from where it was in the middle of the scan."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial import cKDTree

from fmr_cli import PointCloud
from fmr_cli.cloud import transform_points
from fmr_cli.errors import CloudFileError
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.se3 import exp
from fmr_cli.sequence import align_sequence
from fmr_cli.sequence.deskew import deskew, scan_times
from fmr_cli.sequence.journal import Beginning
from fmr_cli.sequence.loader import Loader
from fmr_cli.sequence.prepared_scan import PreparedScan
from fmr_cli.sequence.scans import as_scans
from fmr_cli.sequence.voxel_frame import VoxelFrame
from fmr_cli.synthetic.drives import Drive, Way, spinning, streets


def test_a_turning_scanner_is_undone_to_half_a_millimetre():
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross([0.01, -0.02, 0.07], np.eye(3)).T
    twist[:3, 3] = [0.8, 0.05, -0.02]
    rng = np.random.default_rng(0)
    still, times = rng.uniform(-30, 30, (200, 3)), np.linspace(0, 1, 200)
    seen = [(np.linalg.inv(expm((t - 0.5) * twist)) @ [*x, 1])[:3] for t, x in zip(times, still, strict=True)]
    assert np.abs(deskew(np.array(seen), times, expm(twist)) - still).max() < 5e-4


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("gps_time", [300000.5, 300000.6, 300000.55]),
        ("t", np.array([0, 100, 50], np.uint32)),
        ("timestamp", np.array([0, 100, 50], np.uint64) + np.uint64(1_700_000_000_000_000_000)),
        ("offset_time", [-0.1, 0.0, np.nan]),
    ],
)
def test_times_in_any_unit(name, values):
    cloud = PointCloud(np.zeros((3, 3)), {"intensity": np.ones(3), name: np.asarray(values)})
    assert scan_times(cloud) == pytest.approx([0, 1, 0.5], abs=1e-6)


def test_one_time_for_all_points_is_an_error():
    with pytest.raises(CloudFileError, match="field time is the same for all points"):
        scan_times(PointCloud(np.zeros((3, 3)), {"time": np.ones(3)}))


@pytest.mark.parametrize(("begins", "share"), [(0.5, 0.2), (0.1, 1.0), (0.0, 1.0)])
def test_a_scan_may_last_less_than_the_time_to_the_next(begins, share):
    """0.1 s each, beginning so much later than the one before; 0: times begin anew in each scan."""
    scans = [PointCloud(np.zeros((50, 3)), {"time": 100.0 + begins * i + np.linspace(0, 0.1, 50)}) for i in range(3)]
    beginning = Beginning(VoxelFrame(1.0, np.zeros(3)), np.eye(4), deskewed=True)
    loader = Loader(as_scans(scans), beginning, [], strict=True, keep_clouds=False)
    assert [loader._share(index) for index in range(3)] == pytest.approx([share] * 3)


def test_the_motion_within_a_scan_is_found_with_its_pose_where_the_way_shakes():
    """Scans of 0.1 s, two a second, by a scanner shaken so that none turns as it did between the frames before it."""
    rng = np.random.default_rng(6)
    scene, corners = streets(rng, 60, 40)
    sensor = spinning(16, -15, 15, 600, 50.0, sweep=0.1)
    shaken = Drive(scene, Way(corners, 2.0, wobble=4.0), sensor, 2.0, seed=6)
    scans = list(islice(shaken.scans(), 10))
    truth = shaken.truth()[:10]
    true = np.linalg.inv(truth[:-1]) @ truth[1:]
    poses = align_sequence(scans).poses
    degrees, shift = pose_error(np.linalg.inv(poses[:-1]) @ poses[1:], true)
    # Half a second before, it turned otherwise by 20 deg/s: 2 deg over a scan, half of which would stay in the pose.
    assert np.median(degrees) < 0.15
    assert np.median(shift) < 0.03


def test_a_little_more_motion_moves_thinned_points_as_thinning_anew_would():
    rng = np.random.default_rng(0)
    floor, wall = (
        rng.uniform([-20, -20, 0], [20, 20, 0.05], (8000, 3)),
        rng.uniform([-20, 8, 0], [20, 8.05, 9], (3000, 3)),
    )
    points, sensor, twist = np.concatenate([floor, wall]), np.array([0, 0, 3.0]), np.array([0, 0, 0.01, 0.2, 0.1, 0])
    times = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) % 1
    moved = PreparedScan(points, sensor, times).deskewed(twist)
    anew = PreparedScan(deskew(points, times, exp(twist)), sensor, times)
    apart, which = cKDTree(anew.points).query(moved.points)
    assert np.median(apart) < 0.1 * np.linalg.norm(twist[3:])
    assert np.median(np.einsum("ij,ij->i", moved.normals, anew.normals[which])) > 0.999
    assert np.linalg.norm(moved.normals, axis=1) == pytest.approx(np.ones(len(moved)))


def test_a_motion_within_a_scan_goes_to_voxels_and_back():
    frame = VoxelFrame(0.5, np.array([3.0, -2.0, 1.0]))
    points, twist = np.random.default_rng(0).normal(size=(5, 3)), np.array([0.1, -0.2, 0.05, 0.4, 0.3, -0.1])
    T_voxels = exp(frame.twist_to_voxels(twist))
    there = frame.points_to_voxels(transform_points(exp(twist), points))
    assert transform_points(T_voxels, frame.points_to_voxels(points)) == pytest.approx(there)
    assert frame.twist_to_file(frame.twist_to_voxels(twist)) == pytest.approx(twist)
