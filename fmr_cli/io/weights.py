"""All that a registration has learnt, in one file: safetensors, what is no tensor in its metadata. Without torch.

``encoder.*``: the encoder of whole clouds, its architecture in the metadata; ``decoder.*``: that of its training;
``local.*``: the encoder of local patches; ``verdict`` (metadata, JSON): what ``models/verdict.json`` holds; ``site.*``:
what training has seen of a site, as points. A file may hold any of these; what it lacks is the bundled one's.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import ModelError

BARE = ("point.", "head.")  # names of the local encoder in a file of its own, as ``models/local.safetensors`` is


@dataclass
class Weights:
    """hidden: the widths of the global encoder's hidden layers; layers: the hidden ones and the last, K wide.

    Without a global encoder, layers is empty and feature_dim 0. decoder, local: arrays by name, empty where the file
    holds none. verdict: the calibration, None where the file has none. sites: points (N, 3) of each, near the origin,
    in the scans' unit.
    """

    hidden: tuple[int, ...] = ()
    feature_dim: int = 0
    layers: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    decoder: dict[str, np.ndarray] = field(default_factory=dict)
    local: dict[str, np.ndarray] = field(default_factory=dict)
    verdict: dict[str, Any] | None = None
    sites: list[np.ndarray] = field(default_factory=list)


def weights_bytes(weights: Weights) -> bytes:
    """The weights as a file; ``read_weights`` reads them back bit for bit."""
    from safetensors.numpy import save

    arrays = {f"decoder.{name}": array for name, array in weights.decoder.items()}
    arrays |= {f"local.{name}": array for name, array in weights.local.items()}
    arrays |= {f"site.{number}": points.astype(np.float32) for number, points in enumerate(weights.sites)}
    for i, (W, b) in enumerate(weights.layers):
        arrays |= {f"encoder.layers.{i}.weight": W, f"encoder.layers.{i}.bias": b}
    metadata = {}
    if weights.layers:
        metadata["architecture"] = json.dumps({"hidden": list(weights.hidden), "feature_dim": weights.feature_dim})
    if weights.verdict is not None:
        metadata["verdict"] = json.dumps(weights.verdict)
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, metadata=metadata)


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
        local = part(arrays, "local.") or {name: array for name, array in arrays.items() if name.startswith(BARE)}
        verdict = json.loads(metadata["verdict"]) if "verdict" in metadata else None
        named = part(arrays, "site.")
        sites = [shaped(named, str(number), (len(named[str(number)]), 3)) for number in range(len(named))]
        if local and "architecture" not in metadata:
            return Weights(local=local, verdict=verdict, sites=sites)
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
    return Weights(hidden, feature_dim, layers, part(arrays, "decoder."), local, verdict, sites)


def part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def shaped(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The array of that name as float32. Raises ValueError where it has another shape."""
    if arrays[name].shape != shape:
        raise ValueError(f"{name} is {arrays[name].shape}, its architecture says {shape}")
    return arrays[name].astype(np.float32)
