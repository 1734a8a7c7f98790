"""Which weights a command works with, and on which device: the bundled ones or the user's."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

import torch

from fmr_cli.errors import ModelError
from fmr_cli.feature_metric.encoder import Encoder, load_encoder
from fmr_cli.feature_metric.local import LocalEncoder

Device = Literal["auto", "cpu", "cuda"]


def pick_device(device: Device = "auto") -> torch.device:
    """The device by name; auto is the GPU where there is one. Raises ModelError for cuda without one."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ModelError(
            "--device cuda: this machine has no usable GPU (torch.cuda.is_available() is false); use auto or cpu"
        )
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")


@lru_cache(maxsize=4)
def encoder(model: Path | None = None, device: Device = "auto") -> Encoder:
    """The encoder of a .safetensors file, or the bundled one, loaded once. Raises ModelError."""
    place = pick_device(device)
    if model is not None:
        return load_encoder(model).to(place)
    with bundled_path() as path:
        return load_encoder(path).to(place)


def bundled_path() -> AbstractContextManager[Path]:
    """The bundled encoder's file, for as long as the context is open."""
    return as_file(files("fmr_cli.models") / "base.safetensors")


def bundled_encoder() -> Encoder:
    """The bundled encoder, on the CPU."""
    return encoder(None, "cpu")


@lru_cache(maxsize=1)
def bundled_local_encoder() -> LocalEncoder:
    """The bundled encoder of local patches, on the CPU."""
    from safetensors import safe_open

    with as_file(files("fmr_cli.models") / "local.safetensors") as path, safe_open(str(path), "pt") as file:
        widths = json.loads((file.metadata() or {})["architecture"])
        model = LocalEncoder(tuple(widths["point_widths"]), tuple(widths["head_widths"]))
        model.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118 (no mapping)
    return model.eval().requires_grad_(False)
