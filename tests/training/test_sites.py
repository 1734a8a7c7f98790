"""What a model keeps of sites: parts that belong together grow together, what stands wrong is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli import PointCloud
from fmr_cli.cloud import transform_points
from fmr_cli.multiway.scans import Scan
from fmr_cli.multiway.store import Store
from fmr_cli.training.sites import DETAIL, Sites
from tests.rooms import room_views


@pytest.fixture(scope="module")
def room() -> tuple[Store, list[np.ndarray]]:
    """Five scans of a room, each in a frame of its own, and T_world_scan of each."""
    clouds, poses = room_views(4, 5, 6_000)
    return Store([Scan(str(n), PointCloud(points)) for n, points in enumerate(clouds)], 0, None), poses


def sites_of(store: Store, late: bool = False) -> Sites:
    return Sites(store, None, lambda: late, lambda what, done, total: None)


def moved(part: dict[int, np.ndarray], seed: int) -> dict[int, np.ndarray]:
    """The part in another frame of its own."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 5, 3)
    return {n: T @ pose for n, pose in part.items()}


def test_parts_that_no_pair_joined_grow_together_where_one_is_found_on_the_other(room):
    store, poses = room
    parts = [{n: poses[n] for n in (0, 1, 2)}, moved({n: poses[n] for n in (3, 4)}, 1)]
    (site,) = sites_of(store).learn(parts)
    assert sorted(site) == [0, 1, 2, 3, 4]
    for n in (3, 4):
        E = np.linalg.inv(poses[n]) @ site[n]
        here = store.prepared(n).centre[None]
        assert np.linalg.norm(transform_points(E, here) - here) < 0.05


def test_a_scan_that_stands_wrong_takes_its_right_place(room):
    store, poses = room
    wrong = poses[3].copy()
    wrong[:3, 3] += 1.0, 0.5, 0.0
    (site,) = sites_of(store).learn([{**{n: poses[n] for n in (0, 1, 2, 4)}, 3: wrong}])
    assert np.linalg.norm(site[3][:3, 3] - poses[3][:3, 3]) < 0.1


def test_a_site_on_which_scans_are_found_where_they_do_not_stand_is_not_kept(room, monkeypatch):
    store, poses = room
    part = {n: poses[n] for n in range(4)}
    assert len(sites_of(store).learn([part])) == 1
    told = [(part, {}), ({n: part[n] for n in range(3)}, {3: np.eye(4)})]
    monkeypatch.setattr(Sites, "by_the_others", lambda self, site: told.pop(0))
    assert sites_of(store).learn([part]) == []


def test_two_scans_alone_and_no_time_make_no_site(room):
    store, poses = room
    assert sites_of(store).learn([{n: poses[n] for n in (0, 1)}]) == []
    assert sites_of(store, late=True).learn([{n: poses[n] for n in range(4)}]) == []


def test_a_site_has_no_more_points_than_it_may_have_and_covers_all_scans(room):
    store, poses = room
    part = {n: poses[n] for n in range(3)}
    every, few = sites_of(store).points(part), sites_of(store).points(part, 4_000)
    assert len(few) <= 4_000 < len(every) < 3 * 6_000
    spacing = 2 * store.prepared(0).edge / DETAIL
    for n, pose in part.items():
        seen = transform_points(pose, store.prepared(n).frame.leave(store.prepared(n).points))
        nearest = np.linalg.norm(seen[::200, None] - every[None], axis=2).min(1)
        assert nearest.max() < spacing


def test_the_same_scans_give_the_same_points(room, tmp_path: Path):
    store, poses = room
    parts = [{n: poses[n] for n in range(3)}]
    a, b = (sites_of(store).points(sites_of(store).learn(parts)[0]) for _ in range(2))
    assert a.tobytes() == b.tobytes()
