"""Which weights a command works with, and on which device: the bundled ones or the user's.

Registration on the CPU works in numpy: to import torch takes longer than to register a pair.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property, lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.descriptors.patch_encoder import LocalEncoder
from fmr_cli.errors import ModelError
from fmr_cli.feature_metric.numpy_solver import NumpySolver
from fmr_cli.feature_metric.search import Solver
from fmr_cli.io.weights import Weights, read_weights
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.verdict_weights import Weights as VerdictWeights
from fmr_cli.registration.verdict_weights import usable

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


class Model:
    """All that a registration has learnt, each part made on first use; what ``weights`` lack is the bundled one's.

    name: of the file, for messages.
    """

    def __init__(self, weights: Weights, name: str) -> None:
        self.weights, self.name = weights, name

    @cached_property
    def whole(self) -> NumpySolver:
        """The encoder of whole clouds and its solver, without torch."""
        return NumpySolver(self.weights.layers) if self.weights.layers else model().whole

    @cached_property
    def local(self) -> LocalEncoder:
        """The encoder of local patches. Raises ModelError where the file's does not fit."""
        if not self.weights.local:
            return model().local
        try:
            return LocalEncoder.of(self.weights.local)
        except ValueError as error:
            raise ModelError(
                f"{self.name}: the weights do not fit the local encoder ({error}); use one written by `fmr train`"
            ) from None

    @cached_property
    def verdict(self) -> VerdictWeights:
        """The weights of the verdict's evidence: the file's own, or the bundled ones."""
        return usable(self.weights.verdict)

    @cached_property
    def sites(self) -> list[Prepared]:
        """What the file keeps of sites, made ready to find scans there; the bundled one knows none."""
        return [
            Prepared(PointCloud(points.astype(np.float64), path=Path(f"{self.name}, site {number}")))
            for number, points in enumerate(self.weights.sites, 1)
        ]

    def on(self, device: Device) -> Encoder:
        """The encoder of whole clouds as torch has it."""
        from fmr_cli.feature_metric.encoder import Encoder

        return Encoder.of(self.whole.layers).to(pick_device(device))


def model(path: Path | str | None = None) -> Model:
    """What a .safetensors file holds, or the bundled files; loaded once, and anew where it has changed.

    Raises ModelError where it is missing or does not fit.
    """
    if path is None:
        return _bundled()
    path = Path(path)
    if not path.is_file():
        read_weights(path)  # which says what is wrong
    status = path.stat()
    return _loaded(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=8)
def _loaded(path: Path, changed: int, size: int) -> Model:
    return Model(read_weights(path), str(path))


@lru_cache(maxsize=1)
def _bundled() -> Model:
    with bundled_path() as path, bundled_local_path() as local:
        return Model(replace(read_weights(path), local=read_weights(local).local), "the bundled model")


def load_encoder(path: Path | str) -> Encoder:
    """The encoder of whole clouds of a file, as torch has it, on the CPU. Raises ModelError: missing, does not fit."""
    return model(path).on("cpu")


def encoder(path: Path | None = None, device: Device = "auto") -> Encoder:
    """The encoder of whole clouds of a file, or the bundled one, as torch has it, loaded once. Raises ModelError."""
    return _on_device(model(path), device)


@lru_cache(maxsize=4)
def _on_device(of: Model, device: Device) -> Encoder:
    return of.on(device)


def fast_encoder(path: Path | None = None) -> NumpySolver:
    """The encoder of whole clouds of a file, or the bundled one, without torch. Raises ModelError."""
    return model(path).whole


def local_encoder(path: Path | None = None) -> LocalEncoder:
    """The encoder of local patches of a file, or the bundled one. Raises ModelError."""
    return model(path).local


def solver(path: Path | None = None, device: Device = "auto") -> Solver:
    """The IC solver with an encoder's weights: by torch for cuda, else by numpy. Raises ModelError."""
    if device != "cuda":
        return fast_encoder(path)
    from fmr_cli.feature_metric.solver import OnDevice

    return OnDevice(encoder(path, device))


def bundled_path() -> AbstractContextManager[Path]:
    """The bundled encoder's file, for as long as the context is open."""
    return as_file(files("fmr_cli.models") / "base.safetensors")


def bundled_local_path() -> AbstractContextManager[Path]:
    """The file of the bundled encoder of local patches, for as long as the context is open."""
    return as_file(files("fmr_cli.models") / "local.safetensors")


def bundled_encoder() -> Encoder:
    """The bundled encoder, as torch has it, on the CPU."""
    return model().on("cpu")


def bundled_local_encoder() -> LocalEncoder:
    """The bundled encoder of local patches."""
    return model().local
