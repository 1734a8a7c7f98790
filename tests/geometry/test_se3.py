"""Exponential and logarithm of rigid motions: exact near zero and near pi, batched, differentiable."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from fmr_cli.geometry import se3

ANGLES = (0.0, 1e-12, 1e-8, 1e-4, 0.00999, 0.01001, 0.5, 2.0, math.pi - 1e-3, math.pi - 1e-9)  # about 0.01 forms change


def twists(angle: float, count: int = 200) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    axis, v = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    return torch.cat([angle * axis / axis.norm(dim=1, keepdim=True), v], 1)


@pytest.mark.parametrize("angle", [*ANGLES, math.pi, 5.0])
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    xi = twists(angle)
    generator = torch.zeros(len(xi), 4, 4, dtype=torch.float64)
    generator[:, :3, :3], generator[:, :3, 3] = se3.hat(xi[:, :3]), xi[:, 3:]
    torch.testing.assert_close(se3.exp(xi), torch.linalg.matrix_exp(generator), rtol=0, atol=3e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_gives_back_what_exp_was_given(angle: float) -> None:
    xi = twists(angle)
    torch.testing.assert_close(se3.log(se3.exp(xi)), xi, rtol=0, atol=1e-14)


def test_a_half_turn_has_a_logarithm_of_the_same_motion() -> None:
    T = se3.exp(twists(math.pi))
    torch.testing.assert_close(se3.exp(se3.log(T)), T, rtol=0, atol=1e-14)


def test_a_tiny_rotation_keeps_all_its_digits() -> None:
    xi = twists(1e-9)
    torch.testing.assert_close(se3.log(se3.exp(xi))[:, :3], xi[:, :3], rtol=1e-12, atol=0)


def test_float32_is_exact_to_its_own_rounding() -> None:
    for angle in ANGLES:
        xi = twists(angle)
        torch.testing.assert_close(se3.exp(xi.float()).double(), se3.exp(xi), rtol=0, atol=2e-6)


def test_any_leading_dimensions() -> None:
    xi = twists(0.7, 6).reshape(2, 3, 6)
    T = se3.exp(xi)
    assert T.shape == (2, 3, 4, 4)
    assert se3.log(T).shape == (2, 3, 6)
    torch.testing.assert_close(T[1, 2], se3.exp(xi[1, 2]))


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.00999, 0.01001, 1.0, 3.1])
def test_gradients_are_those_of_finite_differences(angle: float) -> None:
    xi = twists(angle, 2).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp, (xi,))
    assert torch.autograd.gradcheck(lambda x: se3.log(se3.exp(x)), (xi,))


def test_quaternions_of_rotations_that_each_of_the_four_forms_serves() -> None:
    generator = torch.Generator().manual_seed(2)
    q = torch.randn(1000, 4, generator=generator, dtype=torch.float64)
    q = torch.cat([q / q.norm(dim=1, keepdim=True), torch.eye(4, dtype=torch.float64)])
    q = torch.where(q[:, :1] < 0, -q, q)
    R = se3.from_quaternion(q)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), rtol=0, atol=1e-14)
    torch.testing.assert_close(se3.quaternion(R), q, rtol=0, atol=1e-14)


def test_transform_moves_points_batch_by_batch() -> None:
    T = se3.exp(twists(1.0, 4))
    x = torch.randn(7, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    moved = se3.transform(T, x)
    assert moved.shape == (4, 7, 3)
    torch.testing.assert_close(moved[2, 5], T[2, :3, :3] @ x[5] + T[2, :3, 3])


@pytest.mark.parametrize("angle", [*ANGLES, math.pi])
def test_numpy_gives_what_torch_gives(angle: float) -> None:
    xi = twists(angle)
    T = se3.exp(xi)
    np.testing.assert_allclose(se3.exp(xi.numpy()), T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.exp(se3.log(T.numpy())), T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.exp(xi[0].numpy()), T[0], rtol=0, atol=1e-14)


def test_geometry_does_not_import_torch() -> None:
    code = "import sys; from fmr_cli.geometry import observability, pose_error; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_adjoint_carries_a_twist_through_a_pose() -> None:
    rng = np.random.default_rng(8)
    T, xi = se3.exp(rng.normal(size=6)), rng.normal(size=6)
    np.testing.assert_allclose(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T, atol=1e-12)
