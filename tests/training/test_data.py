"""What is trained on and what is held out: apart, all of it counted, and never nothing."""

from __future__ import annotations

import pytest
import torch

from fmr_cli.errors import FmrError
from fmr_cli.training.data import LEAST_HELD_OUT, held_out_count, read_data
from fmr_cli.training.recipe import Recipe
from fmr_cli.training.run_folder import TrainingError

CPU = torch.device("cpu")


def read(recipe: Recipe, scans=()):
    return read_data(list(scans), recipe, None, CPU, lambda done, total: None)


def test_shapes_and_scenes_are_held_out_apart():
    recipe = Recipe(shapes=20, scenes=10, cloud_points=128, held_out=0.1)
    data, warnings = read(recipe)
    assert warnings == []
    assert data.described[0] == f"{20 - LEAST_HELD_OUT} procedural shapes, {LEAST_HELD_OUT} held out"
    assert data.described[1].endswith(f"crops of {10 - LEAST_HELD_OUT} scans of procedural scenes, 8 scans held out")
    assert data.train.shape[1:] == data.held_out.shape[1:] == (128, 3)
    assert len(data.held_out) >= 2 * LEAST_HELD_OUT
    kept = {cloud.numpy().tobytes() for cloud in data.train}
    assert not kept & {cloud.numpy().tobytes() for cloud in data.held_out}


def test_one_scan_alone_is_said(samples_folder):
    data, warnings = read(Recipe(crops=6, cloud_points=128), [samples_folder / "scan_a.ply"])
    assert "one scan alone" in warnings[0]
    assert data.described == [f"6 crops of 1 scans ({samples_folder / 'scan_a.ply'}), 1 crops held out"]


def test_too_little_is_one_line(samples_folder):
    with pytest.raises(TrainingError, match="8 shapes or scenes are too few to hold 8 out"):
        held_out_count(8, Recipe())
    with pytest.raises(FmrError, match="nothing to train on"):
        read(Recipe())
    with pytest.raises(FmrError, match="one crop is too little"):
        read(Recipe(crops=1, cloud_points=128), [samples_folder / "scan_a.ply"])
