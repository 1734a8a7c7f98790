"""The inverse compositional iteration with the bundled encoder, on procedural shapes it was not trained on."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from fmr_cli.evaluation.heldout import Setting, draw, errors, register
from fmr_cli.feature_metric.encoder import Encoder, jacobian
from fmr_cli.feature_metric.solver import make_template, solve
from fmr_cli.geometry import se3
from fmr_cli.geometry.motion import Motion
from fmr_cli.geometry.pose_error import angle_between
from fmr_cli.synthetic.shapes import shapes


def turns(count: int, degrees: float, shift: float = 0.0, seed: int = 0) -> Tensor:
    """Motions (count, 4, 4) about random axes, float32."""
    axis, v = torch.randn(2, count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    axis, v = (x / x.norm(dim=1, keepdim=True) for x in (axis, v))
    return se3.exp(torch.cat([math.radians(degrees) * axis, shift * v], 1)).float()


def degrees_off(g: Tensor, T: Tensor) -> Tensor:
    return torch.from_numpy(np.degrees(angle_between(g[:, :3, :3].double().numpy(), T[:, :3, :3].double().numpy())))


def identity(count: int) -> Tensor:
    return torch.eye(4).repeat(count, 1, 1)


@pytest.mark.parametrize("method", ["exact", "finite"])
@pytest.mark.parametrize("robust", [True, False])
def test_a_known_motion_is_recovered(encoder: Encoder, bodies: Tensor, method: str, robust: bool) -> None:
    few = bodies[:, :512]
    T = turns(len(few), 30, shift=0.05)
    source = se3.transform(torch.linalg.inv(T), few)
    found = solve(encoder, make_template(encoder, few, method), source, identity(len(few)), 15, robust)  # type: ignore[arg-type]
    off = degrees_off(found.g, T)
    assert (off < 0.05).float().mean() > 0.9
    assert (found.g - T)[:, :3, 3].norm(dim=1).median() < 1e-4
    assert (found.error < found.errors[0] / 100).float().mean() > 0.9


def test_every_iteration_s_error_is_kept_and_the_end_is_early(encoder: Encoder, bodies: Tensor) -> None:
    T = turns(2, 10)
    source, template = se3.transform(torch.linalg.inv(T), bodies[:2]), make_template(encoder, bodies[:2])
    found = solve(encoder, template, source, identity(2), iterations=50)
    assert 4 <= len(found.errors) < 25
    assert found.errors.shape[1] == 2
    first = (encoder(source) - encoder(bodies[:2])).abs().mean(-1)
    torch.testing.assert_close(found.errors[0], first)
    last = (encoder(se3.transform(found.g, source)) - encoder(bodies[:2])).abs().mean(-1)
    torch.testing.assert_close(found.error, last)
    assert len(solve(encoder, template, source, identity(2), iterations=3).errors) == 4
    assert torch.equal(solve(encoder, template, source, T, iterations=0).g, T)


def test_missing_parts_pull_robust_weights_off_less_than_plain_least_squares(encoder: Encoder) -> None:
    clouds = torch.from_numpy(shapes(16, 1024, seed=30_000))
    side = torch.randn(16, 3, 1, generator=torch.Generator().manual_seed(5))
    order = (clouds @ side)[..., 0].argsort(1)[..., None].expand(-1, -1, 3)
    along = clouds.gather(1, order)  # points in order along a random direction; each scan lacks one end
    first, second = along[:, : int(0.95 * 1024)], along[:, int(0.05 * 1024) :]
    T = turns(16, 30)
    source, template = se3.transform(torch.linalg.inv(T), second[:, ::2]), make_template(encoder, first[:, 1::2])
    robust, plain = (degrees_off(solve(encoder, template, source, identity(16), 10, r).g, T) for r in (True, False))
    assert (robust < 5).float().mean() >= 0.8
    assert robust.median() < 0.6 * plain.median()


def test_the_mean_of_both_jacobians_errs_by_half(encoder: Encoder, bodies: Tensor) -> None:
    template, xi = make_template(encoder, bodies), se3.log(turns(len(bodies), 16).double())
    moved = se3.transform(se3.exp(-xi).float(), bodies)
    feature, index = encoder.encode(moved)
    r = (feature - template.feature).double()
    mean = (template.J + jacobian(encoder, moved, index).double()) / 2
    once, both = (r - (J @ xi[..., None])[..., 0] for J in (template.J, mean))
    assert both.abs().mean() < 0.6 * once.abs().mean()


@pytest.mark.parametrize(("overlap", "share"), [pytest.param(0.9, 0.8, marks=pytest.mark.slow), (0.8, 0.6)])
def test_cut_and_resampled_shapes_are_registered_from_40_degrees(
    encoder: Encoder, overlap: float, share: float
) -> None:
    pool = torch.from_numpy(shapes(24, 2048, seed=30_000))
    pairs = draw(pool, Setting("", (40, 40), 0.8, overlap=overlap), 24, 512, seed=3)
    robust, plain = (errors(register(encoder, pairs, robust=r), pairs.truth) for r in (True, False))
    assert robust.success >= share
    assert robust.median < 0.5 * plain.median


def test_what_a_point_or_a_line_does_not_determine_shows_in_the_rank_and_stays(encoder: Encoder) -> None:
    point = torch.full((100, 3), 0.3)
    line = torch.linspace(-0.5, 0.5, 100)[:, None] * torch.tensor([0.6, 0.0, 0.8]) + torch.tensor([0.0, 0.1, 0.0])
    target = torch.stack([point, line])
    found = solve(encoder, make_template(encoder, target), target + 0.01, identity(2))
    assert found.rank.tolist() == [3, 5]
    assert torch.isfinite(found.g).all()
    torch.testing.assert_close(se3.transform(found.g, target + 0.01), target, rtol=0, atol=1e-4)
    R = found.g[:, :3, :3]
    assert (R[0] - torch.eye(3)).abs().max() < 1e-5  # a point says nothing about any rotation
    assert (R[1] - torch.eye(3)).abs().max() < 0.01


def test_a_whole_shape_has_full_rank(encoder: Encoder, bodies: Tensor) -> None:
    assert (make_template(encoder, bodies[:4, :256]).rank == 6).all()


@pytest.mark.parametrize(("dof", "up"), [
    ("yaw", (0.0, 0.0, 1.0)), ("yaw", (1.0, 0.0, 0.0)), ("translation", (0.0, 0.0, 1.0)),
    ("planar", (0.0, 0.0, 1.0)), ("planar", (0.0, 1.0, 0.0)),
])  # fmt: skip
def test_a_constrained_motion_never_leaves_its_subgroup(
    encoder: Encoder, bodies: Tensor, dof: str, up: tuple[float, float, float]
) -> None:
    source = se3.transform(turns(4, 20, 0.1), bodies[:4, :256])  # which no constrained motion undoes
    motion = Motion(dof, up)  # type: ignore[arg-type]
    g = solve(
        encoder, make_template(encoder, bodies[:4, :256]), source, identity(4), basis=torch.from_numpy(motion.basis())
    ).g
    axis = torch.tensor(up)
    assert (g - torch.eye(4)).abs().max() > 0.01
    assert torch.equal(g[:, :3, :3] @ axis, axis.expand(4, 3))
    if dof == "translation":
        assert torch.equal(g[:, :3, :3], torch.eye(3).expand(4, 3, 3))
    if dof == "planar":
        assert (g[:, :3, 3] @ axis == 0).all()


def test_a_tilted_axis_is_kept_to_float32_rounding(encoder: Encoder, bodies: Tensor) -> None:
    up = (0.36, 0.48, 0.8)
    axis = torch.tensor(up)
    T = torch.from_numpy(Motion("yaw", up).starts(24)[1:2]).float()  # 15 deg about up
    source = se3.transform(torch.linalg.inv(T), bodies[:1])
    template = make_template(encoder, bodies[:1])
    g = solve(encoder, template, source, identity(1), basis=torch.from_numpy(Motion("yaw", up).basis())).g
    assert (g[0, :3, :3] @ axis - axis).abs().max() < 1e-6
    assert degrees_off(g, T).item() < 0.05


def test_a_shared_template_serves_many_starts(encoder: Encoder, bodies: Tensor) -> None:
    template = make_template(encoder, bodies[:1, :256])
    starts = turns(3, 15)
    together = solve(encoder, template, bodies[:1, :256].expand(3, -1, -1), starts, 5).g
    alone = torch.cat([solve(encoder, template, bodies[:1, :256], s[None], 5).g for s in starts])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-4)
