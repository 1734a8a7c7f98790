from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.geometry.corner import share_beyond_corner
from fmr_cli.geometry.normals import neighbours, normals_and_variation
from fmr_cli.geometry.voxels import voxel_downsample

EDGE = 0.05


def corner(rng: np.random.Generator, sizes: tuple[float, float, float] = (1, 1, 1)) -> np.ndarray:
    """Three sides that meet at right angles."""
    points = rng.uniform(0, 1, (9000, 3)) * sizes
    points[np.arange(9000), np.arange(9000) % 3] = 0
    return points


def ball(rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(9000, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def beyond(points: np.ndarray) -> float:
    points = voxel_downsample(points, EDGE)
    normals = normals_and_variation(points, *neighbours(points, cKDTree(points)))[0]
    return share_beyond_corner(points, normals, EDGE, np.random.default_rng(0))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_corner_has_nothing_beyond_its_three_planes(noise: float) -> None:
    rng = np.random.default_rng(0)
    points = corner(rng)
    assert beyond(points + rng.normal(0, noise, points.shape)) < 0.02


def test_what_stands_in_a_corner_is_beyond_its_planes() -> None:
    rng = np.random.default_rng(0)
    assert 0.05 < beyond(np.concatenate([corner(rng), 0.2 * ball(rng) + 0.5])) < 0.3


def test_a_fourth_plane_is_beyond_three() -> None:
    rng = np.random.default_rng(0)
    slope = rng.uniform(0, 1, (4000, 3)) * [1, 1, 0]
    slope[:, 2] = 2 - slope[:, 0]
    assert beyond(np.concatenate([corner(rng), slope])) > 0.15


def test_of_a_curved_surface_most_is_beyond_its_planes() -> None:
    assert beyond(ball(np.random.default_rng(0))) > 0.5


def test_no_points_have_nothing_beyond() -> None:
    assert share_beyond_corner(np.zeros((0, 3)), np.zeros((0, 3)), EDGE, np.random.default_rng(0)) == 0


def test_planes_that_are_parallel_make_no_corner() -> None:
    """A wall, what stands out from it, and the ground: where along the wall, the fronts tell."""
    rng = np.random.default_rng(0)
    wall, front = (rng.uniform(0, 2, (6000, 3)) * [1, 0, 1] + [0, y, 0] for y in (0.0, 0.3))
    front = front[front[:, 0] % 0.8 < 0.4]
    ground = rng.uniform(0, 2, (6000, 3)) * [1, 1, 0]
    assert beyond(np.concatenate([wall, front, ground])) > 0.1


def test_windows_less_than_two_voxels_deep_are_no_part_of_their_wall() -> None:
    """A third of the wall stands back by 1.4 edges: it does not make the wall that thick."""
    rng = np.random.default_rng(0)
    wall, ground = (rng.uniform(0, 2, (9000, 3)) * scale for scale in ([1, 0, 1], [1, 1, 0]))
    wall[wall[:, 0] % 0.6 < 0.2, 1] = -1.4 * EDGE
    end = rng.uniform(0, 2, (9000, 3)) * [0, 1, 1]
    assert beyond(np.concatenate([wall, ground, end]) + rng.normal(0, 0.002, (27000, 3))) > 0.05


@pytest.mark.parametrize("noise", [0.2, 0.4])
def test_a_noisy_corner_has_hardly_more(noise: float) -> None:
    """Noise in voxel edges, of the points: thickest where it is densest, a plane still holds what it scatters."""
    rng = np.random.default_rng(0)
    points = corner(rng, (2, 2, 2))
    assert beyond(points + rng.normal(0, noise * EDGE, points.shape)) < 0.02
