"""Which weights a command works with, and on which device: the bundled ones or the user's.

Registration on the CPU works in numpy: to import torch takes longer than to register a pair.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from fmr_cli.descriptors.patch_encoder import LocalEncoder
from fmr_cli.errors import ModelError
from fmr_cli.feature_metric.numpy_solver import NumpySolver
from fmr_cli.feature_metric.search import Solver
from fmr_cli.io.weights import read_weights

if TYPE_CHECKING:
    import torch

    from fmr_cli.feature_metric.encoder import Encoder

Device = Literal["auto", "cpu", "cuda"]


def pick_device(device: Device = "auto") -> torch.device:
    """The device by name; auto is the GPU where there is one. Raises ModelError for cuda without one."""
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise ModelError(
            "--device cuda: this machine has no usable GPU (torch.cuda.is_available() is false); use auto or cpu"
        )
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")


def load_encoder(path: Path | str) -> Encoder:
    """The encoder of a .safetensors file, as torch has it, on the CPU. Raises ModelError: missing, or does not fit."""
    from fmr_cli.feature_metric.encoder import Encoder

    return Encoder.of(read_weights(path).layers)


@lru_cache(maxsize=4)
def encoder(model: Path | None = None, device: Device = "auto") -> Encoder:
    """The encoder of a .safetensors file, or the bundled one, as torch has it, loaded once. Raises ModelError."""
    place = pick_device(device)
    if model is not None:
        return load_encoder(model).to(place)
    with bundled_path() as path:
        return load_encoder(path).to(place)


@lru_cache(maxsize=4)
def fast_encoder(model: Path | None = None) -> NumpySolver:
    """The encoder of a .safetensors file, or the bundled one, without torch, loaded once. Raises ModelError."""
    if model is not None:
        return NumpySolver(read_weights(model).layers)
    with bundled_path() as path:
        return NumpySolver(read_weights(path).layers)


def solver(model: Path | None = None, device: Device = "auto") -> Solver:
    """The IC solver with an encoder's weights: by torch for cuda, else by numpy. Raises ModelError."""
    if device != "cuda":
        return fast_encoder(model)
    from fmr_cli.feature_metric.solver import OnDevice

    return OnDevice(encoder(model, device))


def bundled_path() -> AbstractContextManager[Path]:
    """The bundled encoder's file, for as long as the context is open."""
    return as_file(files("fmr_cli.models") / "base.safetensors")


def bundled_local_path() -> AbstractContextManager[Path]:
    """The file of the bundled encoder of local patches, for as long as the context is open."""
    return as_file(files("fmr_cli.models") / "local.safetensors")


def bundled_encoder() -> Encoder:
    """The bundled encoder, as torch has it, on the CPU."""
    return encoder(None, "cpu")


@lru_cache(maxsize=1)
def bundled_local_encoder() -> LocalEncoder:
    """The bundled encoder of local patches."""
    with bundled_local_path() as path:
        return LocalEncoder.load(path)
