"""What the verdict promises: evidence without a unit, and confidences that share out one certainty."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration import confidence
from fmr_cli.registration.agreement import agreement, amid_their_like, in_one_thing
from fmr_cli.registration.pipeline import align
from fmr_cli.registration.verdict_weights import bundled_weights


def ball(rng: np.random.Generator, noise: float) -> np.ndarray:
    points = rng.normal(size=(8000, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [1, 0.8, 0.6] + rng.normal(0, noise, (8000, 3))


def pose(angle: float, shift: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[0, 3] = Rotation.from_rotvec([0, 0, angle], degrees=True).as_matrix(), shift
    return T


def evidence(**given: float) -> confidence.Evidence:
    """What a good pose of two rooms has, but for what is given."""
    usual = {
        "explained": 8000, "contradicted": 100, "missing": 0, "largest": 2, "overlap": 0.9, "explained_share": 0.8,
        "inlier_rmse": 0.01, "offset": 0.7, "turn": 1.0, "detail": 2000, "stretch": 0.0, "votes": 200, "repeats": 0.15,
    }  # fmt: skip
    return confidence.Evidence(**(usual | given))  # type: ignore[arg-type]


def said(*poses: confidence.Evidence) -> list[float]:
    x, largest = np.array([e.vector() for e in poses]), np.array([e.largest for e in poses])
    return confidence.confidences(x, largest, bundled_weights())[0].tolist()


def test_a_rival_that_fits_nearly_as_well_is_doubt_unless_a_thing_stands_out_there() -> None:
    """One bay of a facade is seen from the same side in both scans, and fits a little better for it: or by its door."""
    first = evidence(explained=4300, contradicted=20, offset=0.95, votes=280, repeats=0.4)
    beside = evidence(explained=3800, contradicted=70, offset=1.0, votes=200, repeats=0.4)
    lacking = evidence(explained=3800, contradicted=70, missing=20, largest=26, offset=1.0, votes=200, repeats=0.4)
    assert said(first)[0] > confidence.ALIGNED
    assert said(first, beside)[0] < said(first, lacking)[0]
    assert said(first, lacking)[0] > confidence.ALIGNED
    weights = bundled_weights()
    for rival, doubted in ((beside, True), (lacking, False)):
        x, largest = np.array([e.vector() for e in (first, rival)]), np.array([first.largest, rival.largest])
        assert confidence.rivalled(x, largest, confidence.standing(x, weights)[0], weights) == doubted


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_samples_of_one_surface_differ_as_neighbours_do_at_the_right_pose_alone(noise: float) -> None:
    rng = np.random.default_rng(0)
    source, target = (Surface(ball(rng, noise), 0.05) for _ in range(2))
    right, shifted, turned = (agreement(source, target, T) for T in (np.eye(4), pose(0, 0.05), pose(15, 0)))
    assert right.overlap > 0.99
    assert max(right.offset, right.turn) < 1.2
    assert min(shifted.offset, turned.offset) > 1.3 * right.offset


@pytest.mark.parametrize("edge", [0.05, 0.1])
def test_the_rmse_is_that_to_the_surface_and_not_to_the_next_point(edge: float) -> None:
    """Voxels of one surface lie about half an edge from each other, and a hundredth off it."""
    rng = np.random.default_rng(0)
    source, target = (Surface(ball(rng, 0.0), edge) for _ in range(2))
    found = agreement(source, target, np.eye(4))
    assert found.inlier_rmse < 0.1 * edge
    assert agreement(source, target, pose(0, edge)).inlier_rmse > 3 * found.inlier_rmse


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_evidence_has_no_unit(unit: float) -> None:
    rng = np.random.default_rng(0)
    a, b = ball(rng, 0.01), ball(rng, 0.01)
    here = agreement(Surface(a, 0.05), Surface(b, 0.05), pose(10, 0.02))
    there = agreement(Surface(a * unit, 0.05 * unit), Surface(b * unit, 0.05 * unit), pose(10, 0.02 * unit))
    for name, value in asdict(here).items():
        assert getattr(there, name) == pytest.approx(value * (unit if name == "inlier_rmse" else 1), rel=2e-3, abs=1e-3)


def test_nothing_in_reach_is_no_evidence() -> None:
    surface = Surface(ball(np.random.default_rng(0), 0), 0.05)
    far = agreement(surface, surface, pose(0, 9.0))
    assert far.overlap == far.explained == far.contradicted == 0
    assert far.offset == far.turn == 1


def test_a_surface_that_floats_over_another_contradicts_it() -> None:
    rng = np.random.default_rng(0)
    floor = rng.uniform(-1, 1, (8000, 3)) * [1, 1, 0]
    table = rng.uniform(-0.3, 0.3, (2000, 3)) * [1, 1, 0] + [0, 0, 0.1]
    bare, laid = Surface(floor, 0.05), Surface(np.concatenate([floor, table]), 0.05)
    assert agreement(bare, bare, np.eye(4)).contradicted == 0
    assert agreement(laid, bare, np.eye(4)).contradicted > 100


def test_what_some_points_plainly_deny_all_points_deny(monkeypatch: pytest.MonkeyPatch) -> None:
    """And what they don't deny is what all points say it is."""
    rng = np.random.default_rng(0)
    a, b = Surface(ball(rng, 0.003), 0.05), Surface(ball(rng, 0.003), 0.05)
    quick = [agreement(a, b, T) for T in (pose(2, 0.01), pose(80, 0.0), pose(60, 0.1))]
    monkeypatch.setattr("fmr_cli.registration.agreement.SOME", 1)
    plain = [agreement(a, b, T) for T in (pose(2, 0.01), pose(80, 0.0), pose(60, 0.1))]
    assert quick[0] == plain[0]
    for some, whole in zip(quick[1:], plain[1:], strict=True):
        assert some != whole
        assert whole.contradicted > whole.explained
        assert some.contradicted > some.explained
        assert some.contradicted == pytest.approx(whole.contradicted, rel=0.15)
        assert some.explained_share == pytest.approx(whole.explained_share, abs=0.05)


def test_what_lies_beyond_the_border_of_a_scan_contradicts_nothing() -> None:
    rng = np.random.default_rng(0)
    wall = rng.uniform(0, 1, (20_000, 3)) * [2, 1, 0]
    left, right = Surface(wall[wall[:, 0] < 1.2], 0.05), Surface(wall[wall[:, 0] > 0.8], 0.05)
    assert agreement(left, right, np.eye(4)).contradicted == 0


def test_a_source_of_another_scale_is_stretched() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([ball(rng, 0), ball(rng, 0) * 0.4 + [0.9, 0.5, 0.3]])
    here = agreement(Surface(points, 0.05), Surface(points[::-1], 0.05), np.eye(4))
    grown = agreement(Surface(points * 1.04, 0.05), Surface(points, 0.05), np.eye(4))
    assert here.stretch < 0.002
    assert grown.stretch > 0.01


def test_a_missing_thing_lies_together_and_edges_here_and_there() -> None:
    rng = np.random.default_rng(0)
    wall = np.array([[x, y, 0.0] for x in range(60) for y in range(60)]) + rng.normal(0, 0.1, (3600, 3))
    door = (np.abs(wall[:, 0] - 30) < 5) & (np.abs(wall[:, 1] - 20) < 8)
    scattered = rng.permutation(door)
    assert amid_their_like(wall, door, 3.0) > 0.7 * door.sum()
    assert amid_their_like(wall, scattered, 3.0) < 0.02 * door.sum()
    assert amid_their_like(wall, door & (np.arange(len(wall)) < 2), 3.0) == 0


def test_a_small_thing_is_one_cluster_and_edges_are_many() -> None:
    grid = np.array([[x, y, 0.0] for x in range(60) for y in range(60)])
    door = (np.abs(grid[:, 0] - 30) < 2) & (np.abs(grid[:, 1] - 20) < 4)
    scattered = np.random.default_rng(0).permutation(door)
    assert in_one_thing(grid[door], 1.0).all()
    assert in_one_thing(grid[scattered], 1.0).sum() <= confidence.BY_CHANCE
    assert in_one_thing(grid[:0], 1.0).shape == (0,)


def test_poses_that_fit_as_well_are_not_sure() -> None:
    alone, junk = evidence(), evidence(explained=400, contradicted=900, offset=3.0, votes=4, explained_share=0.1)
    assert said(alone)[0] >= confidence.ALIGNED
    assert said(alone, junk)[0] >= confidence.ALIGNED
    assert said(alone, alone)[0] < 0.6
    assert sum(said(alone, alone, alone)) <= 1 + 1e-9


@pytest.mark.parametrize("against", [
    {"votes": 15, "explained": 2000, "contradicted": 6000, "offset": 3.5, "explained_share": 0.2},
    {"stretch": 0.04, "offset": 2.0, "contradicted": 2000},
    {"votes": 3, "explained": 500, "contradicted": 800, "offset": 3.0, "explained_share": 0.1},
    {"contradicted": 9000, "offset": 1.0},
])  # fmt: skip
def test_contradiction_outweighs_matches(against: dict[str, float]) -> None:
    assert said(evidence(**against))[0] < 0.5


def test_a_mere_corner_is_not_called_sure_however_well_it_fits() -> None:
    assert said(evidence(detail=0, votes=400, explained_share=1.0))[0] < 0.5
    rng = np.random.default_rng(5)
    sides = rng.integers(3, size=5000)
    corner = rng.uniform(0, 1, (5000, 3)) * np.where(rng.random((5000, 1)) < 0.5, 1, 0.8)
    corner[np.arange(5000), sides] = 0
    truth = pose(50, 0.4)
    found = align(PointCloud(corner[::2]), PointCloud(transform_points(truth, corner[1::2])))
    assert found.status == "uncertain"
    assert any("three planes" in reason for reason in found.reasons)


@pytest.mark.slow
def test_a_box_that_fits_turned_over_is_not_called_sure() -> None:
    rng = np.random.default_rng(1)
    sides = np.array([1.0, 0.6, 0.35])
    points = rng.uniform(-1, 1, (12_000, 3))
    points[np.arange(12_000), rng.choice(3, 12_000, p=(1 / sides) / (1 / sides).sum())] = rng.choice([-1, 1], 12_000)
    points = points * sides
    found = align(PointCloud(points[::2]), PointCloud(transform_points(pose(70, 1), points[1::2])))
    assert found.status == "uncertain"
    assert found.alternatives
    assert any("fits about as well turned by 180 deg" in reason for reason in found.reasons)


def test_a_sheet_is_found_by_its_outline() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (60_000, 3)) * [1, 1, 0]
    angle = np.arctan2(points[:, 1], points[:, 0])
    points = points[np.hypot(points[:, 0], points[:, 1]) < rng.uniform(0.3, 1, 24)[((angle + np.pi) * 3.8).astype(int)]]
    truth = pose(0, 1.0)
    truth[:3, :3] = Rotation.random(random_state=3).as_matrix()
    found = align(PointCloud(points[::2]), PointCloud(transform_points(truth, points[1::2])))
    error = np.linalg.inv(truth) @ found.T_target_source
    assert angle_degrees(error) < 1
    assert np.linalg.norm(error[:3, 3]) < 0.02
