"""Voxel grid, working scale, neighbourhoods: all from the data's own extent and spacing, the same every time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.geometry.normals import neighbours, normals_and_variation
from fmr_cli.geometry.sampling import OBLIQUE, WORKING_VOXELS, distinct, sample, working_scale
from fmr_cli.geometry.surface import Surface
from fmr_cli.geometry.voxels import occupied_voxels, voxel_downsample

Scans = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def scan(room_scans: Scans) -> np.ndarray:
    return room_scans[0]


def scale_of(points: np.ndarray) -> tuple[float, float]:
    return working_scale(points, np.random.default_rng(0))


def test_the_voxel_grid_is_the_same_every_time(scan: np.ndarray) -> None:
    assert np.array_equal(voxel_downsample(scan, 0.1), voxel_downsample(scan, 0.1))


def test_a_voxel_holds_the_mean_of_its_points() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [5.1, 0.1, 0.1]])
    grid = voxel_downsample(points, 1.0)
    np.testing.assert_allclose(grid[np.argsort(grid[:, 0])], [[0.2, 0.1, 0.1], [5.1, 0.1, 0.1]], atol=1e-12)


def test_the_working_voxels_are_as_many_as_intended(scan: np.ndarray) -> None:
    edge, _ = scale_of(scan)
    assert 0.9 * WORKING_VOXELS < occupied_voxels(scan, edge) <= WORKING_VOXELS


@pytest.mark.parametrize("unit", [1000.0, 0.001, 39.37])
def test_the_scale_follows_the_unit(scan: np.ndarray, unit: float) -> None:
    np.testing.assert_allclose(scale_of(scan * unit), np.multiply(scale_of(scan), unit), rtol=1e-3)


def test_the_spacing_is_that_of_a_regular_grid() -> None:
    x, y = np.meshgrid(np.arange(80.0), np.arange(80.0))
    _, spacing = scale_of(np.stack([x, y, 0 * x], -1).reshape(-1, 3) * 0.25)
    assert spacing == pytest.approx(0.25, rel=1e-6)


def test_a_few_points_far_away_do_not_matter(scan: np.ndarray) -> None:
    far = np.vstack([scan, [[1e4, 0, 0], [0, -1e4, 0]]])
    np.testing.assert_allclose(scale_of(far), scale_of(scan), rtol=0.15)


def test_a_sample_repeats_no_point_and_follows_the_seed(scan: np.ndarray) -> None:
    some = sample(scan, 500, np.random.default_rng(3))
    assert len(np.unique(some, axis=0)) == 500
    assert np.array_equal(some, sample(scan, 500, np.random.default_rng(3)))
    assert len(sample(scan[:20], 500, np.random.default_rng(3))) == 20


def test_repetitions_go_and_nothing_else(scan: np.ndarray) -> None:
    again = distinct(np.vstack([scan, scan[:300], scan[:1]]))
    assert np.array_equal(np.unique(again, axis=0), np.unique(scan, axis=0))


def test_points_of_a_grid_that_meet_on_the_oblique_line_all_stay() -> None:
    grid = np.random.default_rng(0).integers(-200, 200, (100_000, 3)) / 100
    expected = np.unique(grid, axis=0)
    assert len(np.unique(expected @ OBLIQUE)) < len(expected)
    again = distinct(grid)
    assert len(again) == len(expected)
    assert np.array_equal(np.unique(again, axis=0), expected)


def test_normals_and_variation_of_a_plane_and_a_corner() -> None:
    from scipy.spatial import cKDTree

    x, y = (c.ravel() for c in np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30)))
    floor, wall = np.stack([x, y, 0 * x], 1), np.stack([0 * x, y, x + 1e-3], 1)
    points = np.vstack([floor, wall])
    normals, variation, *_ = normals_and_variation(points, *neighbours(points, cKDTree(points)))
    inside = (points[:, 0] > 0.3) & (points[:, 0] < 0.7)
    np.testing.assert_allclose(np.abs(normals[inside]), np.broadcast_to([0, 0, 1], (inside.sum(), 3)), atol=1e-9)
    edge = (points[:, 0] < 0.05) & (points[:, 2] < 0.05)
    assert variation[inside].max() < 1e-9
    assert np.median(variation[edge]) > 0.02


def test_keypoints_are_spread_out_and_where_the_surface_bends(scan: np.ndarray) -> None:
    edge, _ = scale_of(scan)
    surface = Surface(scan, edge)
    index = surface.keypoints(300)
    assert len(index) == len(set(index)) == 300
    cells = np.floor((surface.points[index] - surface.points.min(0)) / (2 * edge))
    assert len(np.unique(cells, axis=0)) == 300
    variation = normals_and_variation(surface.points, *neighbours(surface.points, surface.tree))[1]
    assert variation[index].mean() > 2 * variation.mean()
    assert np.array_equal(index, Surface(scan, edge).keypoints(300))


def test_a_sheet_has_its_keypoints_on_its_outline() -> None:
    sheet = np.random.default_rng(0).uniform(-1, 1, (9000, 3)) * [1, 0.7, 0]
    surface = Surface(sheet, 0.03)
    found = np.abs(surface.points[surface.keypoints(100)])
    assert np.mean((found[:, 0] > 0.94) | (found[:, 1] > 0.64)) > 0.9


def test_patches_hold_neighbours_within_the_radius_nearest_first(scan: np.ndarray) -> None:
    edge, _ = scale_of(scan)
    surface = Surface(scan, edge)
    index = surface.keypoints(20)
    patches = surface.patches(index, 4.0, 100)
    assert {k: v.shape for k, v in patches.items()} == {
        "offsets": (20, 100, 3), "valid": (20, 100), "normal": (20, 3), "neighbours": (20, 100),
        "normals": (len(surface.points), 3),
    }  # fmt: skip
    length = np.linalg.norm(patches["offsets"], axis=2)
    assert (length[patches["valid"] == 1] <= 1).all()
    assert (np.diff(np.where(patches["valid"] == 1, length, 2), axis=1) >= 0).all()
    brute = np.linalg.norm(surface.points - surface.points[index[0]], axis=1) < 4 * edge
    assert patches["valid"][0].sum() == min(brute.sum(), 100)


def test_keypoints_are_the_best_of_each_block(scan: np.ndarray) -> None:
    surface, block, count = Surface(scan, 0.1), 1.0, 5
    all_of_them = surface.keypoints(len(scan))
    index = surface.keypoints(count, block)
    blocks = np.floor((surface.points - surface.points.min(0)) / block).astype(int)
    for number in np.unique(blocks[all_of_them], axis=0):
        here = [i for i in all_of_them if (blocks[i] == number).all()]
        assert [i for i in index if (blocks[i] == number).all()] == here[:count]
    assert np.array_equal(surface.keypoints(300, 1e6), surface.keypoints(300))


@pytest.mark.parametrize(
    "spread", [(1, 1, 1), (1, 1, 1e-3), (1, 1e-3, 1e-3), (1, 1, 0), (1, 0, 0), (1e-9, 1e-9, 1e-11)]
)
def test_the_closed_form_of_the_normals_is_that_of_lapack(spread: tuple[float, ...]) -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3)) * spread
    tree = cKDTree(points)
    distance, index = neighbours(points, tree)
    normals, variation, *_ = normals_and_variation(points, distance, index)
    near = points[index]
    centred = near - near.mean(1, keepdims=True)
    C = np.swapaxes(centred, 1, 2) @ centred
    values, sums = np.linalg.eigvalsh(C), np.trace(C, axis1=1, axis2=2)
    np.testing.assert_allclose(variation, values[:, 0] / sums, rtol=0, atol=1e-12)
    reached = np.einsum("ni,nij,nj->n", normals, C, normals) / sums  # also where the direction is free
    np.testing.assert_allclose(reached, values[:, 0] / sums, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-12)
