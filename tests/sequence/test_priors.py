"""Poses known beforehand: a tunnel is crossed by them, and where scans tell their pose they change nothing."""

from __future__ import annotations

import numpy as np
import pytest
from degenerate import block, placed, seen, spinning, tunnel, wall

from fmr_cli import PointCloud
from fmr_cli.errors import FmrError
from fmr_cli.geometry.se3 import exp
from fmr_cli.multiway.known import KnownPose
from fmr_cli.sequence import align_sequence


def priors(truth, rng, share=0.02, noise=0.05, turn=0.3):
    """The truth with a wrong scale and noise (m, deg) in each pose, by the clouds' names."""
    poses = truth.copy()
    poses[:, :3, 3] *= 1 + share
    poses = poses @ exp(
        np.hstack([rng.normal(0, np.radians(turn), (len(truth), 3)), rng.normal(0, noise, (len(truth), 3))])
    )
    return poses, {f"cloud_{i:03d}": KnownPose(T) for i, T in enumerate(poses)}


def shift_errors(poses, truth):
    return np.linalg.norm((np.linalg.inv(poses[0]) @ poses)[:, :3, 3] - truth[:, :3, 3], axis=1)


def smooth_tunnel(count):
    rng = np.random.default_rng(0)
    poses = np.array([placed(0.8 * i, 0.1, -0.3) for i in range(count)])
    scans = [PointCloud(seen([tunnel(4.0)], T, spinning(), rng, 0.02, 40.0)) for T in poses]
    return scans, np.linalg.inv(poses[0]) @ poses


def test_a_smooth_tunnel_is_crossed_by_priors_and_better_than_by_them_alone():
    scans, truth = smooth_tunnel(12)
    poses, known = priors(truth, np.random.default_rng(1))
    found = align_sequence(scans, init_poses=known)
    alone, errors = shift_errors(poses, truth), shift_errors(found.poses, truth)
    assert np.sqrt((errors**2).mean()) < np.sqrt((alone**2).mean())
    assert errors.max() < 0.02 * 8.8 + 0.2
    assert all("shift along (1.00, 0.0" in row["unobserved"] for row in found.rows[1:])
    assert found.rows[-1]["sigma_shift"] > errors[-1] / 3


def test_where_scans_tell_their_pose_priors_change_nothing(street):
    folder, truth = street
    known = {f"{i}.bin": KnownPose(T) for i, T in enumerate(priors(truth, np.random.default_rng(2), noise=0.3)[0])}
    found = align_sequence(folder, init_poses=known)
    assert found.status == "aligned"
    assert shift_errors(found.poses, truth).max() < 0.03


def test_a_name_that_no_scan_has_is_one_line(street):
    with pytest.raises(FmrError, match="--init-poses: no scan is called 77"):
        align_sequence(street[0], init_poses={"77": KnownPose(np.eye(4))})


@pytest.mark.slow
def test_the_tunnel_of_the_shared_data(shared_data):
    home = shared_data / "cases" / "sequences"
    names = sorted(file.name for file in (home / "tunnel").iterdir())
    truth = np.tile(np.eye(4), (len(names), 1, 1))
    truth[:, 1, 3] = np.linspace(0, 16, len(names))  # 16 m along y, evenly
    poses, _ = priors(truth, np.random.default_rng(3))
    found = align_sequence(home / "tunnel", init_poses=dict(zip(names, map(KnownPose, poses), strict=True)))
    errors, alone = shift_errors(found.poses, truth), shift_errors(poses, truth)
    assert np.sqrt((errors**2).mean()) < np.sqrt((alone**2).mean())


@pytest.fixture(scope="module")
def hall():
    """A hall as a known map far from the origin, scans of a walk through a part of it, and their true poses in it."""
    rng, far = np.random.default_rng(5), np.array([600_000.0, 5_000_000.0, 100.0])
    things = [wall(0, -20.0), wall(0, 25.0), wall(1, -12.0), wall(1, 14.0), wall(2, -1.5), wall(2, 6.0)]
    for _ in range(30):
        low = np.array([rng.uniform(-18, 20), rng.uniform(3, 10) * rng.choice([-1, 1]), -1.5])
        things.append(block(tuple(low), tuple(low + rng.uniform(0.4, 4.0, 3))))
    rays = spinning(64, 900, -30.0, 30.0)
    places = [placed(x, y, 0.0) for x in (-15.0, -5.0, 5.0, 15.0) for y in (-7.0, 7.0)]
    known = np.concatenate([seen(things, T, rays, rng, 0.01, 60.0) + T[:3, 3] for T in places])
    walk = np.array([placed(-8.0 + 0.5 * i, 1.0 + 0.1 * i, 0.2, 40.0 + 2 * i) for i in range(8)])
    scans = [PointCloud(seen(things, T, spinning(), rng, 0.01, 60.0)) for T in walk]
    walk[:, :3, 3] += far
    return PointCloud(known + far), scans, walk


@pytest.mark.parametrize("told", [False, True])
def test_a_sequence_is_localised_in_a_known_map(hall, told):
    known, scans, truth = hall
    given = {"cloud_000": KnownPose(truth[0] @ placed(0.5, -0.4, 0.1, 5.0))} if told else None
    found = align_sequence(scans, known_map=known, init_poses=given)
    assert found.status == "aligned"
    assert np.linalg.norm(found.poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.05


def test_a_first_pose_beside_the_map_is_one_line(hall):
    known, scans, truth = hall
    aside = KnownPose(truth[0] @ placed(500.0))
    with pytest.raises(FmrError, match="does not fit the map where it is said to be"):
        align_sequence(scans, known_map=known, init_poses={"cloud_000": aside})
