"""Which motions are allowed, the starts among them, and the least squares motion between matched points."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from fmr_cli.feature_metric import se3
from fmr_cli.feature_metric.motion import Motion, rotation_between, rotations
from fmr_cli.feature_metric.search import STARTS

UP = (0.36, 0.48, 0.8)


def uniform_rotations(count: int) -> Tensor:
    q = torch.randn(count, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return q / q.norm(dim=1, keepdim=True)


def test_the_starts_leave_no_rotation_further_than_61_degrees() -> None:
    starts = se3.quaternion(rotations(STARTS)[:, :3, :3])
    nearest = 2 * (uniform_rotations(50_000) @ starts.T).abs().amax(1).clamp(max=1).arccos()
    assert math.degrees(nearest.max()) < 61
    assert math.degrees(nearest.mean()) < 31
    assert math.degrees(2 * (starts @ starts.T - 2 * torch.eye(STARTS)).abs().max().clamp(max=1).arccos()) < 61


def test_more_starts_leave_smaller_gaps() -> None:
    q = uniform_rotations(5_000)
    gaps = [2 * (q @ se3.quaternion(rotations(n)[:, :3, :3]).T).abs().amax(1).clamp(max=1).arccos().max()
            for n in (64, 512, 4096)]  # fmt: skip
    assert gaps[1] < 0.6 * gaps[0]
    assert gaps[2] < 0.6 * gaps[1]


def test_starts_about_one_axis_are_even_and_keep_it() -> None:
    starts = Motion("yaw", UP).starts(64)
    axis = torch.tensor(UP, dtype=torch.float64)
    torch.testing.assert_close(starts[:, :3, :3] @ axis, axis.expand(len(starts), 3))
    gaps = rotation_between(starts[:, :3, :3], starts.roll(1, 0)[:, :3, :3])
    torch.testing.assert_close(gaps, torch.full_like(gaps, 2 * math.pi / len(starts)))
    assert torch.equal(Motion("translation").starts(64), torch.eye(4, dtype=torch.float64)[None])


@pytest.mark.parametrize(("dof", "freedom"), [("rigid", 6), ("yaw", 4), ("translation", 3), ("planar", 3)])
def test_the_basis_is_orthonormal_and_has_the_freedom_of_the_motion(dof: str, freedom: int) -> None:
    motion = Motion(dof, UP)  # type: ignore[arg-type]
    basis = motion.basis()
    assert basis.shape == (6, freedom)
    torch.testing.assert_close(basis.T @ basis, torch.eye(freedom, dtype=torch.float64))
    up = torch.tensor(UP, dtype=torch.float64)
    T = se3.exp((basis @ torch.randn(freedom, 1, dtype=torch.float64))[:, 0])
    if dof != "rigid":
        torch.testing.assert_close(T[:3, :3] @ up, up)
    if dof == "planar":
        assert abs(float(T[:3, 3] @ up)) < 1e-12


def allowed(dof: str, lift: float) -> Tensor:
    up = torch.tensor(UP, dtype=torch.float64)
    twist = {"rigid": torch.tensor([0.7, -1.1, 2.0], dtype=torch.float64), "translation": torch.zeros(3).double()}
    T = se3.exp(torch.cat([twist.get(dof, 2.1 * up), torch.zeros(3)]))
    T[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    if dof == "planar":
        T[:3, 3] += (lift - T[:3, 3] @ up) * up
    return T


@pytest.mark.parametrize("dof", ["rigid", "yaw", "translation", "planar"])
def test_the_fit_finds_the_motion_that_it_may(dof: str) -> None:
    T = allowed(dof, lift=0.3)
    x = torch.randn(2, 40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    y = se3.transform(T, x)
    y[:, :5] += 10  # wrong matches of no weight
    weight = torch.ones(2, 40, dtype=torch.float64)
    weight[:, :5] = 0
    found = Motion(dof, UP, lift=0.3).fit(x, y, weight)  # type: ignore[arg-type]
    torch.testing.assert_close(found, T.expand(2, 4, 4), rtol=0, atol=1e-10)


@pytest.mark.parametrize("dof", ["rigid", "yaw", "translation", "planar"])
def test_float32_rounding_is_put_right_within_the_subgroup(dof: str) -> None:
    T, motion = allowed(dof, 0.3), Motion(dof, UP, lift=0.3)  # type: ignore[arg-type]
    exact = motion.exact(T.float().double()[None])[0]
    torch.testing.assert_close(exact, T, rtol=0, atol=1e-6)
    R, up = exact[:3, :3], torch.tensor(UP, dtype=torch.float64)
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-15)
    if dof != "rigid":
        torch.testing.assert_close(R @ up, up, rtol=0, atol=1e-15)
    if dof == "planar":
        assert abs(float(exact[:3, 3] @ up) - 0.3) < 1e-15


def test_flat_matches_are_turned_not_mirrored() -> None:
    x = torch.randn(1, 20, 3, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.0])
    T = Motion().fit(x, x * torch.tensor([1.0, -1.0, 1.0]), torch.ones(1, 20, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(T[0, :3, :3]).item(), 1.0)
    torch.testing.assert_close(se3.transform(T, x), x * torch.tensor([1.0, -1.0, 1.0]), rtol=0, atol=1e-9)
