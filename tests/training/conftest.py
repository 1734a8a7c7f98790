"""A recipe small enough to run in a second, and clouds to run it on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fmr_cli.synthetic.shapes import shapes
from fmr_cli.training.global_task import Data
from fmr_cli.training.recipe import Recipe


@pytest.fixture(scope="session")
def tiny() -> Recipe:
    return Recipe(
        start="scratch", feature_dim=32, hidden=(16, 16), shapes=24, cloud_points=128, points=64, chamfer_batch=4,
        pose_batch=4, pose_weight=1.0, unroll=2, steps=6, epoch_steps=2, held_out_pairs=2,
    )  # fmt: skip


@pytest.fixture(scope="session")
def data() -> Data:
    pool = torch.from_numpy(shapes(24, 128, seed=0))
    return Data(pool[:16], pool[16:], described=["16 procedural shapes, 8 held out"])


@pytest.fixture(scope="session")
def samples_folder() -> Path:
    """Where the two sample scans are."""
    return Path(__file__).parents[2] / "samples"
