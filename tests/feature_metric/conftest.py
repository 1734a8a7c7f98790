"""Fixtures of the method's tests: the bundled encoder and procedural shapes, as the encoder was trained on."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor

from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.numpy_solver import NumpySolver
from fmr_cli.registration.models import bundled_encoder, fast_encoder
from fmr_cli.synthetic.shapes import shapes


@pytest.fixture(scope="session")
def encoder() -> Encoder:
    torch.set_num_threads(1)
    return bundled_encoder()


@pytest.fixture(scope="session")
def exact_encoder(encoder: Encoder) -> Encoder:
    """The same weights in float64, for derivatives."""
    return copy.deepcopy(encoder).double()


@pytest.fixture(scope="session")
def bodies() -> Tensor:
    """(12, 1024, 3) shapes that no training run drew, normalised, points in random order."""
    return torch.from_numpy(shapes(12, 1024, seed=20_000))


@pytest.fixture(scope="session")
def fast() -> NumpySolver:
    """The bundled encoder without torch."""
    return fast_encoder()


@pytest.fixture(scope="session")
def bodies_numpy(bodies: Tensor) -> np.ndarray:
    return bodies.numpy()


@pytest.fixture(scope="session")
def room(room_scans: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """A scan (12000, 3) of a procedural room, normalised as the encoder takes it, float32, in random order."""
    points = room_scans[0] - room_scans[0].mean(0)
    return (points / (2 * np.abs(points).max())).astype(np.float32)
