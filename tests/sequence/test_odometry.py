"""Odometry: as exact as the data allow, in any unit, from any start, and honest where it is lost."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from degenerate import placed
from simulation import drive, make_street, scan

from fmr_cli.io import read_cloud, read_poses
from fmr_cli.sequence import SequenceOptions, align_sequence, find_scans
from fmr_cli.sequence.local_map import Fit, LocalMap
from fmr_cli.sequence.odometry import Odometry
from fmr_cli.sequence.prepared_scan import FITTED_POINTS, choose_voxel, prepare_scan
from fmr_cli.sequence.voxel_frame import VoxelFrame

REFERENCE = "reference_poses.txt"


@pytest.fixture(scope="session")
def turning():
    """Scans and poses of a drive through a bend at 40 deg/s, in motion from the first scan on; two of them at rest."""
    place, poses, rng = make_street(60), drive(60)[20:42], np.random.default_rng(2)
    return [scan(place, pose, rng, columns=450) for pose in poses], poses


def run(scans):
    """Each scan's frame; None stands for a scan that could not be read."""
    frame = VoxelFrame(choose_voxel(scans[0]), np.median(scans[0], axis=0))
    odometry = Odometry(frame)
    return [odometry.register(None if points is None else prepare_scan(points, frame)) for points in scans]


@pytest.fixture(scope="module")
def first_four(turning):
    """The frames of the bend's first four scans."""
    return run(turning[0][:4])


def errors(frames, truth):
    """Shift of each frame from the truth, as a share of the path so far; and the first step's shift alone."""
    truth = np.linalg.inv(truth[0]) @ truth
    shift = np.linalg.norm([f.T_first_scan[:3, 3] - T[:3, 3] for f, T in zip(frames, truth, strict=True)], axis=1)
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    return shift[-1] / length, shift[1]


def test_a_bend_is_followed_to_two_thousandths_of_its_length(turning):
    scans, truth = turning
    frames = run(scans)
    assert all(frame.status == "aligned" for frame in frames)
    drift, first = errors(frames, truth)
    assert drift < 0.002
    assert first < 0.02


@pytest.mark.parametrize("every", [pytest.param(-1, marks=pytest.mark.slow), 3])
def test_backwards_and_every_third_scan(turning, every):
    scans, truth = turning
    frames = run(scans[::every])
    assert all(frame.status == "aligned" for frame in frames)
    assert errors(frames, truth[::every])[0] < 0.004


@pytest.mark.parametrize(("overlap", "start"), [(0.4, "prediction"), (0.55, "features"), (0.9, "features")])
def test_a_leap_that_registration_is_not_sure_of_has_to_fit_clearly_better(turning, monkeypatch, overlap, start):
    scans = turning[0]
    frame = VoxelFrame(choose_voxel(scans[0]), np.median(scans[0], axis=0))
    odometry = Odometry(frame)
    for points in scans[:5]:
        assert odometry.register(prepare_scan(points, frame)).status == "aligned"
    elsewhere = placed(300.0)
    monkeypatch.setattr(odometry, "_by_features", lambda scan: (SimpleNamespace(status="uncertain"), elsewhere))
    # A door stands before the scanner: nothing fits well, and another place hardly better.
    fits = {"features": Fit(elsewhere, overlap, 1.0, "features")}
    monkeypatch.setattr(odometry.map, "fit", lambda scan, T, levels, name, **_: fits.get(name, Fit(T, 0.35, 1.0, name)))
    found = odometry._best_fit(prepare_scan(scans[5], frame), odometry.motion.expect(None, 1.0))
    assert found.start == start
    assert odometry._frame(found).status == ("uncertain" if start == "features" else "aligned")  # whatever it fits


def test_what_registration_is_not_sure_of_is_no_leap_where_the_motion_led_there_too(turning, monkeypatch):
    scans = turning[0]
    frame = VoxelFrame(choose_voxel(scans[0]), np.median(scans[0], axis=0))
    odometry = Odometry(frame)
    for points in scans[:5]:
        odometry.register(prepare_scan(points, frame))
    expected = odometry.motion.expect(None, 1.0)
    unsure = SimpleNamespace(status="uncertain"), expected.T_map_scan
    monkeypatch.setattr(odometry, "_by_features", lambda scan: unsure)
    fits = {"features": Fit(expected.T_map_scan, 0.9, 1.0, "features")}
    monkeypatch.setattr(odometry.map, "fit", lambda scan, T, levels, name, **_: fits.get(name, Fit(T, 0.35, 1.0, name)))
    found = odometry._best_fit(prepare_scan(scans[5], frame), expected)
    assert (found.start, odometry._frame(found).status) == ("features", "aligned")


@pytest.fixture
def at_a_gap(turning):
    """An odometry after three scans of the bend, the fourth one, where it is in the map, and its fit there."""
    scans = turning[0]
    frame = VoxelFrame(choose_voxel(scans[0]), np.median(scans[0], axis=0))
    odometry = Odometry(frame)
    for points in scans[:3]:
        odometry.register(prepare_scan(points, frame))
    scan = prepare_scan(scans[3], frame)
    T_map_scan = odometry._best_fit(scan, odometry.motion.expect(None, 1.0)).T_map_scan
    return odometry, scan, T_map_scan, odometry.map.fit(scan, T_map_scan, (1.0,), "features")


def said_by_whole_scans(monkeypatch, odometry, T_map_scan, **said):
    """Registration of whole scans says so."""
    T_last_scan = np.linalg.inv(odometry.last[2]) @ T_map_scan
    found = {"T_target_source": T_last_scan, "origin": np.zeros(3), "information": 1e4 * np.eye(6)} | said
    monkeypatch.setattr("fmr_cli.registration.align", lambda *args, **options: SimpleNamespace(**found))


@pytest.mark.parametrize(
    ("off", "status", "confidence", "sure"),
    [(0.0, "aligned", 0.9, True), (0.0, "uncertain", 0.6, False), (3.0, "aligned", 0.9, False)],
)
def test_across_a_gap_all_points_must_put_a_scan_where_the_thinned_ones_do(
    at_a_gap, monkeypatch, off, status, confidence, sure
):
    odometry, scan, T_map_scan, fit = at_a_gap
    said_by_whole_scans(monkeypatch, odometry, placed(off) @ T_map_scan, status=status, confidence=confidence)
    assert odometry._borne_out(scan, T_map_scan, fit) == sure


def test_a_scan_across_a_gap_is_where_all_points_have_it_and_uncertain_where_they_have_it_not(at_a_gap, monkeypatch):
    odometry, scan, T_map_scan, _ = at_a_gap
    monkeypatch.setattr(odometry, "_by_features", lambda scan: (SimpleNamespace(status="uncertain"), T_map_scan))
    monkeypatch.setattr(odometry.map, "fit", lambda scan, T, levels, name, **_: Fit(T, 0.2, 1.0, name))
    for sure in (True, False):
        monkeypatch.setattr(odometry, "_borne_out", lambda scan, T, fit, sure=sure: sure)
        fit = odometry._best_fit(scan, odometry.motion.expect(None, 1.0))
        assert odometry._fits(fit) == sure
        assert not sure or np.allclose(fit.T_map_scan, T_map_scan)


def test_all_points_are_asked_where_no_start_fits_though_the_pose_by_features_does(at_a_gap, monkeypatch):
    odometry, scan, T_map_scan, _ = at_a_gap
    monkeypatch.setattr(odometry, "_by_features", lambda scan: (SimpleNamespace(status="uncertain"), T_map_scan))
    fits = {"features": Fit(T_map_scan, 0.45, 1.0, "features")}  # hardly better than the others, so no leap by itself
    monkeypatch.setattr(odometry.map, "fit", lambda scan, T, levels, name, **_: fits.get(name, Fit(T, 0.3, 1.0, name)))
    monkeypatch.setattr(odometry, "_borne_out", lambda scan, T, fit: True)
    fit = odometry._best_fit(scan, odometry.motion.expect(None, 1.0))
    assert fit.verified
    assert fit.start == "features"


@pytest.mark.parametrize("observed", [True, False])
def test_what_two_scans_across_a_gap_leave_open_the_map_has_to_determine(at_a_gap, monkeypatch, observed):
    odometry, scan, T_map_scan, fit = at_a_gap
    along = np.eye(6)[5]
    weak = 1e4 * (np.eye(6) - np.outer(along, along))  # says nothing of a shift along the third axis
    said_by_whole_scans(monkeypatch, odometry, T_map_scan, status="uncertain", confidence=0.9, information=weak)
    if not observed:
        fit, _ = odometry.map.polish(scan, fit, 0.0)
        seen = replace(fit.seen, information=np.zeros((6, 6)))
        monkeypatch.setattr(odometry.map, "polish", lambda scan, fit, slope: (replace(fit, seen=seen), slope))
    assert odometry._borne_out(scan, T_map_scan, fit) == observed


def test_the_unit_and_the_place_do_not_matter(turning, first_four):
    scans, truth = turning[0][:4], turning[1][:4]
    far = np.array([600_000.0, 5_000_000.0, 100.0])
    millimetres = run([points * 1000 for points in scans])
    for a, b in zip(first_four, millimetres, strict=True):
        assert np.allclose(a.T_first_scan[:3, 3] * 1000, b.T_first_scan[:3, 3], atol=1.0)
    shifted = run([points + far for points in scans])
    moved = np.array([frame.T_first_scan[:3, :3] @ far + frame.T_first_scan[:3, 3] - far for frame in shifted])
    true = (np.linalg.inv(truth[0]) @ truth)[:, :3, 3]
    assert np.abs(moved - true).max() < 0.05


def test_the_same_scans_give_the_same_poses_bit_for_bit(turning, first_four):
    for a, b in zip(first_four, run(turning[0][:4]), strict=True):
        assert np.array_equal(a.T_first_scan, b.T_first_scan)


def test_a_missing_scan_is_bridged_by_the_motion_before(turning):
    scans, truth = turning[0][:10], turning[1][:10]
    frames = run([None if i == 6 else points for i, points in enumerate(scans)])
    assert [i for i, frame in enumerate(frames) if frame.status != "aligned"] == [6]
    true = (np.linalg.inv(truth[0]) @ truth)[:, :3, 3]
    assert np.linalg.norm(frames[6].T_first_scan[:3, 3] - true[6]) < 0.3
    assert np.linalg.norm(frames[9].T_first_scan[:3, 3] - true[9]) < 0.05


@pytest.mark.parametrize(("folder", "suffix"), [("kitti_seq/velodyne", ".bin"), ("hdl64", ".pcd")])
def test_real_lidar(shared_data, folder, suffix):
    home = shared_data / folder
    truth = read_poses(next(p for p in (home, home.parent) if (p / REFERENCE).exists()) / "reference_poses.txt")
    scans = [read_cloud(p, attributes=False).points for p in sorted(home.glob(f"*{suffix}"))[:8]]
    drift, first = errors(run(scans), truth[:8])
    assert drift < 0.004
    assert first < 0.02


def few_of_each_frame(monkeypatch, scans):
    """By frame from the second on: for each fit to the map, whether it went by few points."""
    calls, fit, register = [], LocalMap.fit, Odometry.register

    def told(self, *args, few=False):
        calls[-1].append(few)
        return fit(self, *args, few=few)

    def each(self, *args):
        calls.append([])
        return register(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(LocalMap, "fit", told)
        patch.setattr(Odometry, "register", each)
        align_sequence(scans, options=SequenceOptions(deskew=False))
    return calls[1:]


def test_few_points_find_a_pose_that_is_as_expected_and_no_other(street, monkeypatch):
    scans = find_scans(street[0])
    fits = few_of_each_frame(monkeypatch, scans)
    assert not any(fits[0])
    assert fits[-1] == [True]
    monkeypatch.setattr(Odometry, "_usual", lambda odometry, fit: False)
    first, *others = few_of_each_frame(monkeypatch, scans)[-1]
    assert first
    assert others
    assert not any(others)


def test_few_points_are_a_part_of_the_scan_with_covariances_of_their_own(street):
    scan = prepare_scan(read_cloud(street[0] / "0.bin").points, VoxelFrame(0.3, np.zeros(3)))
    assert len(scan) > FITTED_POINTS >= scan.fitted.size() > FITTED_POINTS / 2
    assert scan.cloud.size() == len(scan)
    small = prepare_scan(scan.points[:FITTED_POINTS] * 0.9, VoxelFrame(1.0, np.zeros(3)))
    assert small.fitted is small.cloud
