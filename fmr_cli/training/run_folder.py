"""The folder of a run: every file is whole at any time, and its state is all that a killed run needs to go on."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fmr_cli.errors import FmrError, ModelError
from fmr_cli.io.files import atomic_write
from fmr_cli.training.recipe import AnyRecipe, read_recipe
from fmr_cli.training.task import Scores

MODEL, STATE, RECIPE, METRICS, CARD = (
    "model.safetensors",
    "state.safetensors",
    "recipe.toml",
    "metrics.csv",
    "README.md",
)


class TrainingError(FmrError):
    """A run that cannot go on."""


@dataclass
class Progress:
    """Where the run is. best is the epoch whose weights model.safetensors holds; 0 is the start."""

    step: int = 0
    steps: int = 0
    epoch: int = 0
    best: int = 0
    seconds: float = 0.0
    scores: dict[str, Scores] = field(default_factory=dict)  # by epoch
    planned: bool = True  # whether ``steps`` fits the minutes that were asked for
    check: dict[str, Any] | None = None  # what the last test of the kept model has given


@dataclass(frozen=True)
class RunFolder:
    """Writes and reads the files of a run in ``path``."""

    path: Path

    def make(self) -> None:
        """Raises TrainingError where there can be no such folder."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TrainingError(
                f"{self.path}: cannot make this folder ({error.strerror}); give another --out"
            ) from None

    def write(self, name: str, content: str | bytes) -> None:
        """A file of the run, under a temporary name first. Raises CloudFileError where it cannot be written."""
        with atomic_write(self.path / name) as temporary:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)

    def add_metrics(self, row: dict[str, Any]) -> None:
        """One more row of metrics.csv; rows of a later epoch, from before a resumed state, go."""
        path = self.path / METRICS
        old = list(csv.DictReader(io.StringIO(path.read_text()))) if path.is_file() and row["epoch"] else []
        rows = [r for r in old if int(r["epoch"]) < row["epoch"]] + [row]
        text = io.StringIO()
        names = list(dict.fromkeys(name for r in rows for name in r))
        table = csv.DictWriter(text, names, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        self.write(METRICS, text.getvalue())

    def save_state(
        self, modules: dict[str, nn.Module], optimiser: torch.optim.Optimizer, progress: Progress, recipe: str
    ) -> None:
        """Everything that the next step depends on, in one file."""
        from safetensors.torch import save

        tensors = {f"{kind}.{n}": v for kind, module in modules.items() for n, v in module.state_dict().items()}
        for i, parameter in enumerate(parameters(optimiser)):
            tensors |= {f"adam.{i}.{k}": v for k, v in optimiser.state.get(parameter, {}).items()}
        metadata = {"progress": json.dumps(asdict(progress)), "recipe": recipe}
        self.write(STATE, save(held(tensors), metadata))

    def load_state(
        self, modules: dict[str, nn.Module], optimiser: torch.optim.Optimizer, device: torch.device
    ) -> Progress:
        """Puts the last state into modules and optimiser. Raises ModelError where it does not fit them."""
        from safetensors import SafetensorError, safe_open

        path = self.path / STATE
        try:
            with safe_open(str(path), "pt", device=str(device)) as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            for kind, module in modules.items():
                own = {n.removeprefix(f"{kind}."): v for n, v in tensors.items() if n.startswith(f"{kind}.")}
                module.load_state_dict(own)
            for i, parameter in enumerate(parameters(optimiser)):
                own = {n.split(".", 2)[2]: v for n, v in tensors.items() if n.startswith(f"adam.{i}.")}
                if own:
                    optimiser.state[parameter] = own
            return Progress(**json.loads(metadata["progress"]))
        except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise ModelError(f"{path}: no state to resume ({reason}); run without --resume") from None

    def saved_recipe(self) -> AnyRecipe:
        """The recipe of a run that is to be resumed. Raises FmrError where the folder holds none."""
        if not (self.path / STATE).is_file():
            raise TrainingError(f"{self.path}: holds no {STATE}, so there is no run to resume; run without --resume")
        return read_recipe(self.path / RECIPE)


def parameters(optimiser: torch.optim.Optimizer) -> list[Tensor]:
    """What an optimiser changes, in its order."""
    return [parameter for group in optimiser.param_groups for parameter in group["params"]]


def held(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors as safetensors takes them."""
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
