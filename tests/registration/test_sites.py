"""Two scans that hardly overlap, of a site that the model knows: found there one by one, or left alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud
from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.errors import ModelError
from fmr_cli.io.weights import read_weights, weights_bytes
from fmr_cli.registration import Options, align, prepare, sites
from fmr_cli.registration.confidence import ALIGNED
from fmr_cli.registration.models import model
from fmr_cli.registration.pipeline import on_site
from fmr_cli.registration.prepared import Prepared
from fmr_cli.synthetic import scenes


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A room seen all round, and two scans of it that look away from each other, all in the room's frame."""
    rng = np.random.default_rng(4)
    room = scenes.room(rng)
    eye = np.array([0.0, 0.0, 1.4])
    site = np.concatenate([scenes.room_scan(room, rng, eye, turn, 3)[::4] for turn in np.arange(0, 6.2, 0.7)])
    one, other = (scenes.room_scan(room, rng, eye, turn, 3)[::3] for turn in (0.3, 0.3 + np.pi))
    return site, one, other


@pytest.fixture(scope="module")
def pair(walk) -> tuple[PointCloud, PointCloud, np.ndarray]:
    """The two scans, each in a frame of its own, and T_target_source."""
    rng, frames = np.random.default_rng(5), []
    for _ in range(2):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 20, 3)
        frames.append(T)
    source, target = (PointCloud(transform_points(T, points)) for T, points in zip(frames, walk[1:], strict=True))
    return source, target, frames[1] @ np.linalg.inv(frames[0])


def knowing(path: Path, *known: np.ndarray) -> Path:
    """A model file that knows sites besides what is bundled."""
    path.write_bytes(weights_bytes(replace(model().weights, sites=list(known))))
    return path


def test_two_scans_that_look_away_from_each_other_have_a_pose_by_way_of_the_site(tmp_path, walk, pair):
    source, target, truth = pair
    assert align(source, target).status == "uncertain"
    found = align(source, target, Options(model=knowing(tmp_path / "m.safetensors", walk[0])))
    assert (found.status, found.start) == ("aligned", sites.START)
    assert angle_degrees(np.linalg.inv(truth) @ found.T_target_source) < 1
    here = source.points.mean(0)[None]
    off = np.linalg.norm(transform_points(found.T_target_source, here) - transform_points(truth, here))
    assert off < 0.05
    assert found.overlap < 0.2
    assert ALIGNED <= found.confidence < 1
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()  # every direction is determined, by the site
    assert found.undetermined == found.reasons == []
    assert "site" in found.seconds


def test_its_covariance_is_that_of_both_scans_on_the_site(walk, pair):
    """Each is surer of its own place than of the two places together; a turn there shifts what lies far off."""
    source, target = (prepare(cloud) for cloud in pair[:2])
    site = prepare(PointCloud(walk[0]))
    there = [sites.likeliest(on_site(scan, site, Options())) for scan in (source, target)]
    assert all(there)
    found = sites.composed(source, target, Options(), *there)
    turns = [np.trace(x.covariance[:3, :3]) for x in (there[0].found, there[1].found, found)]
    assert turns[2] == pytest.approx(turns[0] + turns[1])
    np.testing.assert_allclose(found.information @ found.covariance, np.eye(6), atol=1e-6)


def test_a_scan_that_two_sites_may_be_is_on_neither(tmp_path, walk, pair):
    source, target, _ = pair
    found = align(source, target, Options(model=knowing(tmp_path / "m.safetensors", walk[0], walk[0] + 3.0)))
    assert found.status == "uncertain"
    assert found.start != sites.START


def test_a_pose_that_the_options_do_not_allow_is_none(tmp_path, walk, pair):
    source, target, truth = pair
    path = knowing(tmp_path / "m.safetensors", walk[0])
    near = 0.5 * angle_degrees(truth)
    assert align(source, target, Options(model=path, max_angle=near)).start != sites.START


@pytest.mark.parametrize(
    "options", [{"init": "features"}, {"dof": "yaw"}, {"scale": True}, {"unit": "mm:m"}, {"init": np.eye(4)}]
)
def test_a_start_or_a_motion_of_one_s_own_asks_no_site(options):
    assert sites.asked(Options())
    assert sites.asked(Options(max_shift=3.0, voxel_size=0.1))
    assert not sites.asked(Options(**options))


def test_what_a_scan_is_on_is_sought_once(tmp_path, walk, pair, monkeypatch):
    sought = []
    monkeypatch.setattr("fmr_cli.registration.pipeline.on_site", lambda *given: sought.append(given) or [])
    source, target = (prepare(cloud) for cloud in pair[:2])
    options = Options(model=knowing(tmp_path / "m.safetensors", walk[0]))
    for _ in range(2):
        align(source, target, options)
    assert len(sought) == 1  # the source is on no site: the target need not be sought at all


def test_a_file_keeps_its_sites_and_an_odd_one_is_one_line(tmp_path, walk):
    path = knowing(tmp_path / "m.safetensors", walk[0], walk[1])
    kept = read_weights(path).sites
    assert [len(points) for points in kept] == [len(walk[0]), len(walk[1])]
    np.testing.assert_array_equal(kept[0], walk[0].astype(np.float32))
    assert all(isinstance(site, Prepared) for site in model(path).sites)
    assert model().sites == []
    path = knowing(tmp_path / "odd.safetensors", walk[0][:, :2])
    with pytest.raises(ModelError, match="the weights do not fit"):
        read_weights(path)


def test_of_two_poses_that_are_one_the_more_exact_is_given_and_of_two_none_is_aligned(walk, pair):
    source, target = (prepare(cloud) for cloud in pair[:2])
    site = prepare(PointCloud(walk[0]))
    there = [sites.likeliest(on_site(scan, site, Options())) for scan in (source, target)]
    known = sites.composed(source, target, Options(), *there)
    assert known is not None
    near, far = known.T_target_source.copy(), known.T_target_source.copy()
    near[:3, 3] += 0.01
    far[:3, 3] += 1.0
    alone = replace(known, T_target_source=near, start="features", confidence=0.999)
    exact, rough = (replace(alone, information=factor * known.information) for factor in (0.5, 0.2))
    assert sites.believed(source, exact, known).start == "features"
    found = sites.believed(source, rough, known)
    assert (found.start, found.confidence) == (sites.START, 0.999)
    assert sites.believed(source, replace(alone, status="uncertain"), known) is known
    doubted = sites.believed(source, replace(alone, T_target_source=far), known)
    assert (doubted.status, doubted.start, doubted.confidence) == ("uncertain", sites.START, sites.EITHER)
    assert "another pose (confidence 1.00)" in doubted.reasons[0]
