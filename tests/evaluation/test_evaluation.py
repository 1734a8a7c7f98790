"""The paper's experiments: errors are what they are called, a setting makes the pairs it says, methods see the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmr_cli.evaluation.experiments import EXPERIMENTS, Clouds, at_level, feature_maps
from fmr_cli.evaluation.heldout import Setting, draw, errors
from fmr_cli.evaluation.methods import baselines, ours
from fmr_cli.geometry import se3
from fmr_cli.registration.models import bundled_encoder
from fmr_cli.synthetic.shapes import others


@pytest.fixture(scope="module")
def clouds():
    return Clouds("others", torch.from_numpy(others(6, 1024, seed=2)), [])


def test_errors_are_the_angle_the_shift_and_the_rmse_of_the_twist():
    truth = se3.exp(torch.tensor([[0.1, 0.2, -0.3, 1, 2, 3], [0, 0, 0, 0, 0, 0]], dtype=torch.float64))
    twist = torch.tensor([[0, np.radians(7), 0, 0, 0, 0], [0, 0, 0, 0.3, 0, 0]], dtype=torch.float64)
    found = errors(truth @ se3.exp(twist), truth)
    assert found.rotation == pytest.approx([7, 0], abs=1e-9)
    assert found.translation == pytest.approx([0, 0.3], abs=1e-12)
    assert found.rmse == pytest.approx([np.radians(7) / np.sqrt(6), 0.3 / np.sqrt(6)])
    assert found.success == 0.5


def test_an_estimate_that_is_not_a_number_is_half_a_turn():
    found = errors(torch.full((1, 4, 4), torch.nan), torch.eye(4)[None])
    assert found.success == 0
    assert np.isfinite(found.rmse).all()


def test_a_setting_makes_the_pairs_it_says(clouds):
    same = draw(clouds.points, Setting("", (30, 30), resample=False), 6, 256, seed=0)
    angles = torch.rad2deg(se3.log(same.truth)[:, :3].norm(dim=1))
    assert angles == pytest.approx(30, abs=0.01)
    assert torch.allclose(se3.transform(same.truth, same.source), same.target, atol=1e-5)
    sparse = draw(clouds.points, Setting("", (0, 60), density=0.1), 6, 256, seed=0)
    assert sparse.source.shape[1] == 25
    assert sparse.target.shape[1] == 256


def test_the_baselines_have_a_pointnetlk_with_weights_of_its_own(clouds):
    methods, missing = baselines("cpu", 10)
    assert "LM-ICP" in methods
    assert len(methods) + len(missing) == 5
    pairs = draw(clouds.points, Setting("", (20, 20), resample=False), 12, 512, seed=0)
    assert errors(methods["PointNetLK"](pairs), pairs.truth).success > 0.8


@pytest.mark.parametrize("robust", [True, False])
def test_the_bundled_encoder_registers_shapes_of_kinds_it_never_saw(clouds, robust):
    pairs = draw(clouds.points, Setting("", (40, 40), shift=0.8, resample=False), 24, 512, seed=0)
    found = errors(ours(bundled_encoder(), 10, robust)(pairs), pairs.truth)
    assert found.success > 0.9
    assert found.median < 0.1


def test_every_method_sees_the_same_pairs(clouds):
    method = ours(bundled_encoder(), 3, True)
    experiment, methods = EXPERIMENTS["density"], {"a": method, "b": method}
    rows = [row for number in range(4) for row in at_level(experiment, number, clouds, methods, 4, 128, seed=0)]
    assert [(r.level, r.method) for r in rows] == [(level, m) for level in (1.0, 0.5, 0.25, 0.1) for m in "ab"]
    assert all(a.rotation_mean == b.rotation_mean for a, b in zip(rows[::2], rows[1::2], strict=True))


def test_feature_maps_come_closer_over_the_iterations(clouds):
    maps = feature_maps(bundled_encoder(), clouds, 512, seed=1)
    gaps = [float((source - target).abs().mean()) for target, source in maps.values()]
    assert list(maps) == [1, 5, 10]
    assert gaps[2] < gaps[0]
