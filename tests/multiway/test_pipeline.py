"""Many scans from Python: placed where they belong, whatever the order, the workers and what is wrong with some."""

from __future__ import annotations

import numpy as np
import pytest
from rooms import room_views

from fmr_cli import FmrError, Options, PointCloud, align_many, write_cloud
from fmr_cli.multiway.known import Known, KnownLink, KnownPose


def test_every_scan_is_placed_where_it_belongs(network, room, worst_error):
    assert [scan.component for scan in network.scans] == [0] * 4
    assert network.whole
    rot, shift = worst_error([scan.T_component_scan for scan in network.scans], room[1])
    assert rot < 0.3
    assert shift < 0.02
    anchor = next(scan for scan in network.scans if scan.name == network.anchors[0])
    assert np.array_equal(anchor.T_component_scan, np.eye(4)), "the frame is the anchor's own"
    assert anchor.sigma_shift == 0
    assert all(0 < scan.sigma_shift < 0.02 for scan in network.scans if scan is not anchor)
    assert all(0 < scan.residual < 0.02 for scan in network.scans)


def test_links_that_hold_agree_with_the_truth(network, room):
    from fmr_cli.cloud import angle_degrees

    aligned = [link for link in network.links if link.status == "aligned"]
    assert len(aligned) >= 6
    for link in aligned:
        true = np.linalg.inv(room[1][link.target]) @ room[1][link.source]
        assert angle_degrees(np.linalg.inv(true) @ network.pose(link)) < 3
        assert link.residual_shift < 0.1


@pytest.mark.slow
def test_the_same_bits_with_one_worker(network, room):
    again = align_many([PointCloud(points) for points in room[0]], workers=1)
    for a, b in zip(network.scans, again.scans, strict=True):
        assert np.array_equal(a.T_component_scan, b.T_component_scan)
        assert np.array_equal(a.covariance, b.covariance)
    assert [(x.source, x.target, x.status) for x in network.links] == [
        (x.source, x.target, x.status) for x in again.links
    ]


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 3])  # sparse views contradict little
def test_scans_of_two_places_are_two_components(room, every):
    (first, second), _ = room_views(21, 2)
    found = align_many([PointCloud(points[::every]) for points in (first, *room[0][:2], second)], workers=2)
    assert sorted(map(sorted, found.components)) == [[0, 3], [1, 2]], "a component holds scans of one place alone"
    assert not found.whole


def known_links(network, names, wrong=()):
    """The aligned links of a network as known ones; those named are turned by half a radian."""
    from scipy.spatial.transform import Rotation

    links = []
    for link in network.links:
        if link.status != "aligned":
            continue
        T = network.pose(link).copy()
        ends = (names[link.source], names[link.target])
        if ends in wrong:
            T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0.1, 0.5, 0]).as_matrix()
        links.append(KnownLink(*ends, "known", T))
    return links


@pytest.mark.slow
def test_a_wrong_link_does_no_harm_and_is_named(network, room, worst_error):
    names = [scan.name for scan in network.scans]
    tie = {n: sum(n in x.ends for x in network.links if x.status == "aligned") for n in range(4)}
    bad = max((x for x in network.links if x.status == "aligned"), key=lambda x: min(tie[x.source], tie[x.target]))
    ends = (names[bad.source], names[bad.target])
    known = Known(links=known_links(network, names, wrong=[ends]))
    found = align_many([PointCloud(points) for points in room[0]], known=known, workers=2)
    rejected = [(names[x.source], names[x.target]) for x in found.links if x.status == "rejected"]
    assert rejected == [ends]
    assert found.whole
    rot, shift = worst_error([scan.T_component_scan for scan in found.scans], room[1])
    assert rot < 0.3
    assert shift < 0.02


@pytest.mark.slow
def test_fixed_scans_stay_and_the_others_come_into_their_frame(room, worst_error):
    clouds, truth = (several[:3] for several in room)
    poses = {"cloud_001": KnownPose(truth[1])}
    found = align_many([PointCloud(x) for x in clouds], known=Known(poses=poses, fixed=["cloud_001"]), workers=2)
    assert np.allclose(found.scans[1].T_component_scan, truth[1], atol=1e-9)
    for n in (0, 2):
        assert np.allclose(found.scans[n].T_component_scan[:3, 3], truth[n][:3, 3], atol=0.05)
    assert found.anchors == [None]


def test_rough_poses_bound_the_search(room):
    clouds, truth = room
    far = truth[2].copy()
    far[:3, 3] += [100.0, 0, 0]
    poses = {f"cloud_{n:03d}": KnownPose(T, 2.0, 0.1) for n, T in enumerate([truth[0], truth[1], far])}
    found = align_many([PointCloud(x) for x in clouds[:3]], known=Known(poses=poses, anchor="cloud_000"), workers=2)
    assert [scan.component for scan in found.scans] == [0, 0, None], "what lies 100 m away is not even looked at"
    expected = np.linalg.inv(truth[0]) @ truth[1]
    assert np.allclose(found.scans[1].T_component_scan[:3, 3], expected[:3, 3], atol=0.05)


@pytest.mark.slow
def test_bad_scans_among_good_ones_are_rows(room, tmp_path):
    for n in range(3):
        write_cloud(tmp_path / f"{n}.ply", PointCloud(room[0][n]))
    (tmp_path / "broken.ply").write_text("ply\nnonsense")
    files = [tmp_path / "2.ply", tmp_path / "broken.ply", tmp_path / "0.ply", tmp_path / "1.ply"]
    found = align_many([*files, tmp_path / "0.ply"], workers=2)
    status = {scan.name: scan.status for scan in found.scans}
    assert status["broken"] == "failed"
    assert [status[str(n)] for n in range(3)] == ["placed"] * 3
    twin = next(scan for scan in found.scans if scan.name == "0_2" or "same file" in scan.message)
    assert twin.status == "failed"
    assert "same file" in twin.message
    assert not found.whole


def test_one_scan_is_no_network(room):
    with pytest.raises(FmrError, match="two or more"):
        align_many([PointCloud(room[0][0])])


def test_a_bound_on_the_shift_keeps_scans_apart(room):
    found = align_many([PointCloud(x) for x in room[0][:2]], Options(max_shift=1e-3), workers=1)
    assert [scan.component for scan in found.scans] == [None, None]


@pytest.mark.slow
def test_levelled_scans_stay_level(room):
    clouds, truth = (several[:3] for several in room)
    level = [x @ T[:3, :3].T + [3.0 * n, 0, 0] for n, (x, T) in enumerate(zip(clouds, truth, strict=True))]
    found = align_many([PointCloud(x) for x in level], Options(dof="yaw"), workers=2)
    assert found.whole
    for scan in found.scans:
        assert abs(scan.T_component_scan[2, 2] - 1) < 1e-6
