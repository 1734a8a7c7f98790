"""The working voxel follows from the scans: from their density, their rings and their noise."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.errors import RegistrationError
from fmr_cli.sequence.prepared_scan import choose_voxel, prepare_scan, suitable_voxel
from fmr_cli.sequence.voxel_frame import VoxelFrame


def floor(rng, count, noise, size=20.0):
    """Points (count, 3) of a square."""
    return np.column_stack([rng.uniform(0, size, (count, 2)), rng.normal(0, noise, count)])


def rings(apart):
    """Points (N, 3) along straight lines, 1 cm from each other."""
    x, y = np.meshgrid(np.arange(0, 20, 0.01), np.arange(0, 20, apart))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def test_it_goes_with_the_unit():
    points = floor(np.random.default_rng(0), 8000, 0.01)
    assert suitable_voxel(1000 * points) == pytest.approx(1000 * suitable_voxel(points), rel=1e-6)


def test_few_points_have_at_least_two_in_a_voxel():
    points = floor(np.random.default_rng(0), 8000, 0.0)
    edge = suitable_voxel(points)
    assert (edge / 20) ** 2 * 8000 > 1.5  # of a filled square


def test_noise_asks_for_larger_voxels():
    clean, noisy, wild = (suitable_voxel(floor(np.random.default_rng(0), 40_000, noise)) for noise in (0.0, 0.05, 1.0))
    assert 1.5 * clean < noisy
    assert wild < 10 * clean  # what only strays, at any edge, does not end in a handful of voxels


def test_between_lines_far_apart_voxels_are_not_left_empty():
    edge = suitable_voxel(rings(1.0))
    assert edge > 0.05  # at the edge of the count alone, 0.03, ten neighbours are all of one line


def test_later_scans_count_and_those_that_cannot_be_used_do_not():
    rng = np.random.default_rng(0)
    narrow, wide = floor(rng, 8000, 0.0, 2.0), floor(rng, 8000, 0.0, 40.0)
    first = choose_voxel(narrow)
    assert choose_voxel(narrow, others=[wide, wide]) > 10 * first
    assert choose_voxel(narrow, others=[np.zeros((500, 3)), wide[:3]]) == first
    assert choose_voxel(narrow, wish=100.0) < 1.3 * first
    with pytest.raises(RegistrationError, match="in one place"):
        choose_voxel(np.zeros((500, 3)), others=[wide])


def test_what_lies_further_off_than_voxels_can_be_told_apart_is_no_measurement():
    points = floor(np.random.default_rng(0), 500, 0.01)
    astray = np.insert(points, 200, [[1e30, 0.0, 0.0], [0.0, -3e6, 0.0]], axis=0)
    frame = VoxelFrame(1.0, np.zeros(3))
    scan, same = prepare_scan(astray, frame, np.linspace(0, 1, 502)), prepare_scan(points, frame)
    assert np.array_equal(scan.points, same.points)
    assert len(scan.when) == len(scan)
    assert prepare_scan(1e30 * points, frame) is None
