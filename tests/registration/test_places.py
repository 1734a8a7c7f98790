"""A scan in a map that is many times as large: its place is found, and believed only if it is the only such place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.registration import Options, align, places, prepare
from fmr_cli.registration.models import local_encoder
from fmr_cli.registration.pair import Pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch
from fmr_cli.synthetic import scenes, sensors

APART = 12.0  # m, from room to room
ROWS = 3


def surfaces(number: int, seed: int) -> np.ndarray:
    """A sample of what is in room ``number``, and of its walls: (n, 3)."""
    room = scenes.room(np.random.default_rng((1, number)))
    return sensors.surface_scan(room, np.random.default_rng((2, seed)), 20.0, shells=[0]).points


def place(number: int) -> np.ndarray:
    return np.array([APART * (number % ROWS), APART * (number // ROWS), 0])


def tiled(numbers: list[int]) -> Prepared:
    """A map of rooms, row by row."""
    rooms = [surfaces(n, at) + place(at) for at, n in enumerate(numbers)]
    return prepare(PointCloud(np.concatenate(rooms)))


def scan(number: int) -> tuple[PointCloud, np.ndarray]:
    """Another sample of a room, turned and shifted, and the pose that takes it back."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=3).as_matrix(), [50, -20, 5]
    return PointCloud(transform_points(T, surfaces(number, 77))), np.linalg.inv(T)


@pytest.fixture(scope="module")
def rooms() -> Prepared:
    return tiled(list(range(ROWS**2)))


@pytest.mark.slow
def test_the_place_of_a_scan_in_a_map_is_found(rooms: Prepared) -> None:
    source, back = scan(5)
    found = align(source, rooms, threads=1)
    truth = transform_points(back, source.points) + place(5)
    off = np.linalg.norm(transform_points(found.T_target_source, source.points) - truth, axis=1)
    assert found.status == "aligned"
    assert off.max() < 0.05
    assert found.points["target"] == rooms.read


@pytest.mark.slow
def test_a_scan_of_a_room_that_the_map_has_twice_is_not_sure() -> None:
    source, _ = scan(5)
    found = align(source, tiled([0, 1, 2, 5, 4, 5, 6, 7, 8]), threads=1)
    assert found.status == "uncertain"
    assert found.alternatives
    assert any("shifted by 24" in reason for reason in found.reasons)


def test_parts_keep_to_the_largest_shift_that_is_allowed(rooms: Prepared) -> None:
    source = prepare(PointCloud(surfaces(0, 77)))
    every, near = (
        list(places.part_centres(source, rooms, Options(max_shift=shift), source.reach)) for shift in (None, APART)
    )
    assert 0 < len(near) < len(every)
    assert all(np.linalg.norm(centre + rooms.centre - source.centre) < 3 * APART for centre in near)


def test_clouds_of_about_one_size_are_no_scan_and_map(rooms: Prepared) -> None:
    source = prepare(PointCloud(surfaces(0, 77)))
    assert places.is_map(source, rooms, Options())
    assert not places.is_map(source, source, Options())
    assert not places.is_map(rooms, source, Options())
    assert not places.is_map(source, rooms, Options(init="identity"))


def test_a_target_of_too_many_parts_has_none(rooms: Prepared) -> None:
    cup = prepare(PointCloud(surfaces(0, 77) * 0.01))
    assert list(places.part_centres(cup, rooms, Options(), cup.reach)) == []
    assert places.look(cup, rooms, Options(), 1, Stopwatch()) is None


def test_a_glance_finds_the_place(rooms: Prepared) -> None:
    cloud, back = scan(5)
    source = prepare(cloud)
    pair = Pair(source, rooms, Options(), places.notched(1.5 * source.edge, rooms), 250)
    centres = list(places.part_centres(source, rooms, Options(), source.reach))
    best = pair.leave_centred(places.glance(pair, centres, source.reach)[0].T_target_source)
    truth = transform_points(back, source.centre[None]) + place(5)
    assert np.linalg.norm(transform_points(best, source.centre[None]) - truth) < 1


def test_a_map_is_described_once_for_scans_of_about_one_size(rooms: Prepared) -> None:
    lengths = np.linspace(0.1, 0.12, 20)
    notches = np.array([places.notched(length, rooms) for length in lengths])
    assert len({*notches}) <= 2
    assert ((lengths <= notches) & (notches < places.NOTCH * lengths)).all()
    encoder = local_encoder()
    assert rooms.described_evenly(0.3, 50, 5.0, encoder) is rooms.described_evenly(0.3, 50, 5.0, encoder)


def test_a_notch_has_no_unit_of_its_own(rooms: Prepared) -> None:
    feet = rooms.scaled(3.28084)
    assert places.notched(0.4 * 3.28084, feet) == pytest.approx(3.28084 * places.notched(0.4, rooms), rel=1e-6)


def test_a_map_is_described_as_a_scan_is(rooms: Prepared) -> None:
    encoder = local_encoder()
    keypoints, descriptors = rooms.described(0.3, 2500, encoder)
    for threads in (1, 2):
        rooms._described.kept.clear()
        evenly = rooms.described_evenly(0.3, 2500, 1e6, encoder, threads)
        assert np.array_equal(evenly[0], keypoints)
        np.testing.assert_allclose(evenly[1], descriptors, atol=1e-5)
