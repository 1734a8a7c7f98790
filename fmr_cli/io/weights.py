"""The encoder's weights in a file: safetensors, the architecture in its metadata. Without torch."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmr_cli.errors import ModelError


@dataclass
class Weights:
    """hidden: the hidden layers' widths; layers: the hidden ones and the last, K wide.

    decoder: the decoder's arrays by name, empty where the file holds none.
    """

    hidden: tuple[int, ...]
    feature_dim: int
    layers: list[tuple[np.ndarray, np.ndarray]]
    decoder: dict[str, np.ndarray]


def weights_bytes(weights: Weights) -> bytes:
    """Encoder and decoder as a file; ``read_weights`` reads them back bit for bit."""
    from safetensors.numpy import save

    arrays = {f"decoder.{name}": array for name, array in weights.decoder.items()}
    for i, (W, b) in enumerate(weights.layers):
        arrays |= {f"encoder.layers.{i}.weight": W, f"encoder.layers.{i}.bias": b}
    architecture = {"hidden": list(weights.hidden), "feature_dim": weights.feature_dim}
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return save(arrays, metadata={"architecture": json.dumps(architecture)})


def read_weights(path: Path | str) -> Weights:
    """What ``weights_bytes`` made. Raises ModelError where the file is missing or does not fit."""
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no such model file; give a .safetensors file written by `fmr train`")
    try:
        with safe_open(str(path), "np") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, TypeError) as error:  # TypeError: a number format that numpy does not have
        raise ModelError(f"{path}: not a safetensors file ({error}); give one written by `fmr train`") from None
    try:
        architecture = json.loads(metadata["architecture"])
        hidden, feature_dim = tuple(int(w) for w in architecture["hidden"]), int(architecture["feature_dim"])
        layers = [
            (shaped(arrays, f"encoder.layers.{i}.weight", (b, a)), shaped(arrays, f"encoder.layers.{i}.bias", (b,)))
            for i, (a, b) in enumerate(itertools.pairwise((3, *hidden, feature_dim)))
        ]
        if sum(name.startswith("encoder.") for name in arrays) > 2 * len(layers):
            raise ValueError("more layers than its architecture says")
    except (KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ModelError(
            f"{path}: the weights do not fit the encoder ({reason}); use one written by `fmr train`"
        ) from None
    decoder = {k.removeprefix("decoder."): v for k, v in arrays.items() if k.startswith("decoder.")}
    return Weights(hidden, feature_dim, layers, decoder)


def shaped(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The array of that name as float32. Raises ValueError where it has another shape."""
    if arrays[name].shape != shape:
        raise ValueError(f"{name} is {arrays[name].shape}, its architecture says {shape}")
    return arrays[name].astype(np.float32)
