"""What is no surface is told by the points alone, and what is one is kept."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.geometry.strays import spheres, strays

Scans = tuple[np.ndarray, np.ndarray]


def told(points: np.ndarray) -> tuple[np.ndarray, dict[str, int]]:
    found = strays(points, np.random.default_rng(0))
    return found.keep, found.reasons


def shell(count: int, radius: float, centre: tuple[float, float, float]) -> np.ndarray:
    v = np.random.default_rng(3).normal(size=(count, 3))
    return radius * v / np.linalg.norm(v, axis=1, keepdims=True) + centre


@pytest.mark.parametrize("stray", [
    shell(1500, 40.0, (0.5, -0.3, 1.0)), np.zeros((900, 3)), np.random.default_rng(1).normal(0, 1, (5, 3)) * 1e5,
], ids=["maximum range", "origin", "far"])  # fmt: skip
def test_strays_are_set_aside_and_nothing_else(room_scans: Scans, stray: np.ndarray) -> None:
    keep, reasons = told(np.concatenate([room_scans[0], stray]))
    assert keep[: len(room_scans[0])].all()
    assert not keep[len(room_scans[0]) :].any()
    assert list(reasons.values()) == [len(stray)]


def test_a_room_and_a_sphere_have_none(room_scans: Scans) -> None:
    for points in (room_scans[0], shell(3000, 2.0, (0, 0, 0))):
        keep, reasons = told(points)
        assert keep.all()
        assert reasons == {}


def test_a_cloud_of_one_point_is_left_to_others() -> None:
    assert told(np.ones((500, 3)))[0].all()


def test_spheres_go_through_their_points_and_four_in_a_plane_have_none() -> None:
    points = np.random.default_rng(2).normal(size=(5, 4, 3))
    points[3, :, 2] = 1.0
    centre, radius = spheres(points)
    apart = np.linalg.norm(points - centre[:, None], axis=2)
    round_ = np.arange(5) != 3
    np.testing.assert_allclose(apart[round_], np.repeat(radius[round_, None], 4, 1))
    assert radius[3] == 0
