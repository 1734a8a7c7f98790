"""The last geometric step, and what the scans say about its certainty."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.geometry import gicp, observability, point_to_plane
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.surface import Surface

Scans = tuple[np.ndarray, np.ndarray]
EDGE = 0.08


def motion(degrees: float, shift: float, axis: tuple[float, float, float] = (0.36, 0.48, 0.8)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    T[:3, 3] = shift * np.array([0.6, -0.64, 0.48])
    return T


def off(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees and metres (at a point 2 m away) between two motions."""
    angle = Rotation.from_matrix((T @ np.linalg.inv(truth))[:3, :3]).magnitude()
    return float(np.degrees(angle)), float(np.linalg.norm((T - truth) @ [1, 1, 1, 1]))


@pytest.fixture(scope="module")
def scans(room_scans: Scans) -> Scans:
    return room_scans


def test_gicp_makes_a_near_pose_exact(scans: Scans) -> None:
    truth = motion(40, 1.0)
    source = (scans[0] - truth[:3, 3]) @ truth[:3, :3]
    start = motion(1.5, 0.05, (0.8, 0.0, 0.6)) @ truth
    first, second = (
        gicp.gicp(gicp.GicpCloud(source, EDGE), gicp.GicpCloud(scans[1], EDGE), start, EDGE) for _ in range(2)
    )
    degrees, metres = off(first, truth)
    assert degrees < 0.1
    assert metres < 0.01
    assert np.array_equal(first, second)


@pytest.mark.parametrize("dof", ["yaw", "translation", "planar"])
def test_a_constrained_polish_is_exact_and_stays_in_its_subgroup(scans: Scans, dof: str) -> None:
    basis = Motion(dof).basis()  # type: ignore[arg-type]
    truth = motion(0 if dof == "translation" else 3, 0.0, (0.0, 0.0, 1.0))
    truth[:2, 3] = 0.06, -0.04
    truth[2, 3] = 0 if dof == "planar" else 0.05
    source = (scans[0] - truth[:3, 3]) @ truth[:3, :3]
    T = point_to_plane.constrained(source, scans[1], np.eye(4), EDGE, basis, scale=False)
    degrees, metres = off(T, truth)
    assert degrees < 0.1
    assert metres < 0.01
    np.testing.assert_allclose(T[2, :3], [0, 0, 1], rtol=0, atol=1e-14)
    if dof == "translation":
        assert np.array_equal(T[:3, :3], np.eye(3))
    if dof == "planar":
        assert abs(T[2, 3]) < 1e-14


def test_the_scale_is_found(scans: Scans) -> None:
    basis = Motion().basis()
    source = scans[0] / 1.02
    T = point_to_plane.constrained(source, scans[0], np.eye(4), EDGE, basis, scale=True)
    assert np.cbrt(np.linalg.det(T[:3, :3])) == pytest.approx(1.02, abs=2e-4)


def test_nothing_in_reach_leaves_the_pose(scans: Scans) -> None:
    T = motion(10, 100.0)
    assert np.array_equal(point_to_plane.constrained(scans[0], scans[1], T, EDGE, Motion().basis(), False), T)


def grid(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.meshgrid(u, v)
    return a.ravel(), b.ravel()


def plane() -> np.ndarray:
    x, y = grid(np.arange(-2, 2, 0.04), np.arange(-1.5, 1.5, 0.04))
    return np.stack([x, y, 0 * x], 1)


def corridor() -> np.ndarray:
    x, s = grid(np.arange(-4, 4, 0.06), np.arange(-1, 1, 0.06))
    one = np.ones_like(x)
    sides = [[x, s, -one], [x, s, one], [x, -one, s], [x, one, s]]
    return np.concatenate([np.stack(side, 1) for side in sides])


def cylinder() -> np.ndarray:
    z, angle = grid(np.arange(-2, 2, 0.06), np.linspace(0, 2 * np.pi, 100, endpoint=False))
    return np.stack([np.cos(angle), np.sin(angle), z], 1)


def shaken(points: np.ndarray, seed: int) -> np.ndarray:
    return points + np.random.default_rng(seed).normal(0, 0.003, points.shape)


@pytest.mark.parametrize(("shape", "said"), [
    (plane, {"shift along (1.00, 0.00, 0.00)", "shift along (0.00, 1.00, 0.00)", "rotation about (0.00, 0.00, 1.00)"}),
    (corridor, {"shift along (1.00, 0.00, 0.00)"}),
    (cylinder, {"shift along (0.00, 0.00, 1.00)", "rotation about (0.00, 0.00, 1.00)"}),
])  # fmt: skip
def test_what_a_shape_does_not_determine_is_named(shape, said: set[str]) -> None:
    points = shape()
    source, target = (Surface(shaken(points, seed), 0.1) for seed in (0, 1))
    info = observability.information(source, target, np.eye(4), np.zeros(3))
    weak = observability.undetermined(info, 2.0)
    assert len(weak) == len(said)
    kinds = sorted(w.split(" (")[0] for w in weak)
    assert kinds == sorted(s.split(" (")[0] for s in said)
    if shape is not plane:  # whose two shifts may be named by any two directions in it
        assert {w.replace("-0.01", "0.00").replace("0.01", "0.00") for w in weak} == said


def test_a_room_determines_everything(scans: Scans) -> None:
    source, target = (Surface(s, EDGE) for s in scans)
    info = observability.information(source, target, np.eye(4), np.zeros(3))
    assert info.shape == (6, 6)
    np.testing.assert_allclose(info, info.T, rtol=1e-9, atol=1e-9 * np.abs(info).max())
    assert np.linalg.eigvalsh(info).min() > 0
    assert observability.undetermined(info, 2.0) == []


def test_more_noise_is_less_information() -> None:
    points = corridor()
    still, noisy = (
        observability.information(Surface(points + n, 0.1), Surface(points, 0.1), np.eye(4), np.zeros(3))[2, 2]
        for n in np.random.default_rng(0).normal(0, 1, (2, 1, *points.shape)).reshape(2, -1, 3) * [[[0.002]], [[0.02]]]
    )
    assert still > 10 * noisy
