"""The encoder of local patches: InfoNCE between two made-up scans' views of one place, no real scan and no label."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from fmr_cli.descriptors.patch_encoder import CHANNELS
from fmr_cli.registration.models import model
from fmr_cli.training.local_views import Views, some_points
from fmr_cli.training.losses import half_precision
from fmr_cli.training.recipe import LocalRecipe
from fmr_cli.training.run_folder import held
from fmr_cli.training.task import Scores, Task, ramped_cosine

RANK1 = "rank-1"  # column of metrics.csv
RAMP = 100  # steps over which the rate rises
EXCLUDED = -1e4  # a logit whose exponential is 0 in bfloat16 and float32 alike


class LocalNet(nn.Module):
    """``LocalEncoder`` as it is trained: (K, PATCH_POINTS, CHANNELS) -> (K, 32), unit length."""

    def __init__(self, point: tuple[int, ...] = (64, 128, 128), head: tuple[int, ...] = (128, 32)) -> None:
        super().__init__()
        self.point = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise((CHANNELS, *point)))
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise((point[-1], *head)))

    @classmethod
    def of(cls, weights: dict[str, Tensor]) -> LocalNet:
        """The network of these weights, whatever the widths of its layers."""

        def widths(part: str) -> tuple[int, ...]:
            names = sorted(name for name in weights if name.startswith(part) and name.endswith("weight"))
            return tuple(len(weights[name]) for name in names)

        net = cls(widths("point"), widths("head"))
        net.load_state_dict(weights)
        return net

    def forward(self, patches: Tensor) -> Tensor:
        x = patches
        for layer in self.point:
            x = torch.relu(layer(x))
        x = x.amax(-2)
        for layer in self.head[:-1]:
            x = torch.relu(layer(x))
        return nn.functional.normalize(self.head[-1](x), dim=-1)


def read_local_start(name: str) -> dict[str, Tensor] | None:
    """The weights to start from: "scratch" is None, "base" the bundled ones, else a file's. Raises ModelError."""
    return None if name == "scratch" else local_start(None if name == "base" else Path(name))


def local_start(path: Path | None) -> dict[str, Tensor]:
    """The weights of a file's local encoder, of the bundled one where it has none or is None. Raises ModelError."""
    return {name: torch.from_numpy(array) for name, array in model(path).local.arrays().items()}


def info_nce(a: Tensor, b: Tensor, views: Views, temperature: float, apart: float) -> Tensor:
    """InfoNCE of descriptors a (n, d), b (m, d) whose first ``views.common`` rows correspond.

    What lies nearer to a patch's counterpart than ``apart``, or looks the same and lies elsewhere, does not repel.
    """
    n, losses = views.common, []
    label = torch.arange(n, device=a.device)
    for x, y, p, alias in ((a, b, views.place_target, views.alias), (b, a, views.place, views.alias_target)):
        logits = x[:n] @ y.T / temperature
        close = (torch.cdist(p[:n], p) < apart) | alias
        close[label, label] = False
        losses.append(nn.functional.cross_entropy(logits.masked_fill(close, EXCLUDED), label))
    return (losses[0] + losses[1]) / 2


def described(net: LocalNet, chosen: list[Views]) -> list[tuple[Tensor, Tensor]]:
    """The descriptors of each pair's source and target, from one pass."""
    with half_precision(chosen[0].source.device):
        all_of_them = net(torch.cat([x for v in chosen for x in (v.source, v.target)])).float()
    parts = iter(all_of_them.split([len(x) for v in chosen for x in (v.source, v.target)]))
    return [(next(parts), next(parts)) for _ in chosen]


class LocalTask(Task):
    """Trains ``LocalNet`` on ``material`` by ``recipe``, from the weights ``start`` or, where it is None, from nothing.

    The first pairs of the material are held out.
    """

    recipe: LocalRecipe
    measure, measured = "held-out rank-1", "the nearest descriptor is of the same place"
    clip = math.inf  # descriptors have unit length, which bounds the gradient

    def __init__(
        self, recipe: LocalRecipe, material: list[Views], device: torch.device, start: dict[str, Tensor] | None
    ) -> None:
        self.recipe, self.device, self.clouds = recipe, device, 2 * recipe.batch
        self.held_out, self.material = material[: recipe.held_out_pairs], material[recipe.held_out_pairs :]
        patches = sum(len(views.place) for views in self.material)
        self.described = [
            f"{len(self.material)} pairs of procedural scans with {patches} corresponding patches, "
            f"{len(self.held_out)} pairs held out"
        ]
        torch.manual_seed(recipe.seed)
        self.net = (LocalNet() if start is None else LocalNet.of(start)).to(device)
        self.modules: dict[str, nn.Module] = {"local": self.net}

    def losses(self, step: int, steps: int, generator: torch.Generator) -> dict[str, Tensor]:
        """InfoNCE of a batch of pairs."""
        order = torch.randperm(len(self.material), generator=generator, device=self.device)
        seen = some_points(self.recipe.patch_points, generator)
        chosen = [self.material[int(i)].sparser(seen).to(self.device) for i in order[: self.recipe.batch]]
        temperature, apart = self.recipe.temperature, self.recipe.apart
        pairs = zip(described(self.net, chosen), chosen, strict=True)
        return {"info_nce": torch.stack([info_nce(a, b, v, temperature, apart) for (a, b), v in pairs]).mean()}

    def rate(self, step: int, steps: int) -> float:
        return ramped_cosine(step, 0, steps, self.recipe.learning_rate, ramp=RAMP)

    @torch.no_grad()
    def test(self) -> Scores:
        """How often the nearest descriptor among the other scan's is of the same place, within ``apart``."""
        shares = []
        for views in (views.to(self.device) for views in self.held_out):
            nearest = (self.net(views.source[: views.common]) @ self.net(views.target).T).argmax(1)
            off = (views.place_target[nearest] - views.place[: views.common]).norm(dim=1)
            shares.append(float((off < self.recipe.apart).float().mean()))
        return {"same place": {RANK1: float(np.mean(shares))}}

    def quality(self, scores: Scores) -> tuple[float, ...]:
        return (scores["same place"][RANK1],)

    def may_choose(self, step: int) -> bool:
        return True

    def weights(self) -> bytes:
        """The file that ``LocalEncoder.load`` reads."""
        from safetensors.torch import save

        return save(held(self.net.state_dict()))

    def shown(self, scores: dict[str, float]) -> str:
        return f"{scores[RANK1]:.3f}"

    def gain(self, before: Scores, after: Scores) -> str:
        return ""

    def card(self) -> list[str]:
        recipe = self.recipe
        return [
            "The encoder of local patches, in the format of `models/local.safetensors`, whose place it can take.",
            "",
            f"- Encoder: {sum(p.numel() for p in self.net.parameters())} parameters, started from {recipe.start}.",
            f"- Data: {'; '.join(self.described)}.",
            f"- Loss: InfoNCE at temperature {recipe.temperature:g}, {recipe.batch} pairs a step; places nearer than "
            f"{recipe.apart:g} voxel edges do not repel each other.",
            f"- Tested on {len(self.held_out)} held-out pairs: how often the nearest of up to {recipe.patches} "
            f"descriptors is of the same place, within {recipe.apart:g} voxel edges.",
        ]
