"""Times from azimuth: found where made-up scans were measured on the move, and only there."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest

from fmr_cli import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.sequence import SequenceOptions, align_sequence, find_scans
from fmr_cli.sequence.azimuth import Revolution, is_revolution, places
from fmr_cli.sequence.pipeline import begin
from fmr_cli.sequence.scans import as_scans
from fmr_cli.synthetic.drives import Drive, Way, spinning, streets

FRAMES = 16


@pytest.fixture(scope="module")
def shaken():
    """Scans that last until the next one, of a shaken scanner; they begin at its back and go counter-clockwise."""
    scene, corners = streets(np.random.default_rng(4), 60, 40)
    return Drive(scene, Way(corners, 1.0, wobble=12.0), spinning(16, -15, 15, 900, 60.0, sweep=0.1), 10.0, seed=4)


def without_times(drive):
    """The scans in no order of their points."""
    rng = np.random.default_rng(0)
    return [PointCloud(rng.permutation(scan.points)) for scan in islice(drive.scans(), FRAMES)]


def step_degrees(poses, drive):
    truth = drive.truth()[: len(poses)]
    found, true = (np.linalg.inv(path[:-1]) @ path[1:] for path in (poses, truth))
    return np.median(pose_error(found, true)[0])


def test_times_follow_from_azimuth_where_that_makes_scans_fit(shaken):
    scans = without_times(shaken)
    result = align_sequence(scans)
    found = result.revolution
    assert found.counterclockwise
    assert abs(found.start - 0.5) < 1 / 20  # turns
    assert found.share > 0.5
    assert "points' times from azimuth" in "\n".join(result.summary())
    assert {row["deskewed_by"] for row in result.rows} == {"azimuth"}
    as_they_are = align_sequence(scans, options=SequenceOptions(deskew=False))
    assert as_they_are.revolution is None
    assert step_degrees(result.poses, shaken) < 0.5 * step_degrees(as_they_are.poses, shaken)


def test_a_revolution_the_other_way_is_found_as_well(shaken):
    """A world in a mirror: all is as before, but clockwise."""
    mirrored = as_scans([PointCloud(scan.points * [1, -1, 1]) for scan in without_times(shaken)])
    found = begin(mirrored, SequenceOptions(), None).revolution
    assert not found.counterclockwise
    assert abs(found.start - 0.5) < 1 / 20


def test_scans_without_motion_in_them_are_left_as_they_are(shaken):
    still = replace(shaken, sensor=replace(shaken.sensor, sweep=0.0))
    scans = without_times(still)
    result = align_sequence(scans)
    assert result.revolution is None
    assert all("deskewed_by" not in row for row in result.rows)
    with pytest.raises(CloudFileError, match=r"no time per point .* nor does their azimuth show any motion"):
        align_sequence(scans, options=SequenceOptions(deskew=True))


@pytest.mark.parametrize("folder", ["kitti_seq/velodyne", "hdl64"])
def test_real_scans_that_are_deskewed_already_are_left_as_they_are(shared_data, folder):
    result = align_sequence(find_scans(shared_data / folder, stop=8))
    assert result.revolution is None


@pytest.mark.parametrize(("counterclockwise", "expected"), [(True, [0.25, 0.5, 0.0]), (False, [0.75, 0.5, 1.0])])
def test_times_of_a_revolution_either_way(counterclockwise, expected):
    """Points at the left, ahead and the right of a scanner that begins at its right."""
    points = np.array([[1.0, 0, 0], [0, 1.0, 2.0], [0, -1.0, 0]])
    assert Revolution(0.75, counterclockwise, 1.0).times(points) == pytest.approx(expected)


def test_only_scans_to_all_sides_are_revolutions():
    angle = np.linspace(-np.pi, np.pi, 1000)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(1000)], 1)
    assert is_revolution(PointCloud(around))
    assert not is_revolution(PointCloud(around[300:700]))


@pytest.mark.parametrize(("count", "number"), [(3, 0), (5, 1), (16, 2), (24, 3), (1000, 6)])
def test_places_lie_within_the_sequence_and_apart(count, number):
    first = places(count)
    assert len(first) == number
    assert all(place >= 0 and place + 4 <= count for place in first)
    assert all(b - a >= 4 for a, b in pairwise(first))
