"""The training loop: steps, a held-out test an epoch, the best kept, a state from which a killed run goes on exactly.

Every random number of a step follows from (seed, step, rank), so that the state needs no generator's.
Under torchrun every process takes its own batches, gradients are averaged, and the first process tests and writes.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from fmr_cli.errors import FmrError, ModelError
from fmr_cli.evaluation.heldout import HARD, score
from fmr_cli.feature_metric.decoder import Decoder, chamfer
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.io.files import atomic_write
from fmr_cli.synthetic.batches import (
    Augment,
    Pairs,
    draw_clouds,
    draw_pairs,
    make_pairs,
    random_motions,
    random_rotations,
)
from fmr_cli.training.losses import anchor_loss, draw_anchors, encode, pose_loss
from fmr_cli.training.recipe import Recipe, read_recipe
from fmr_cli.training.weights import load_weights, save_encoder

RAMP = 100  # steps over which the learning rate rises from zero
LAST_RATE = 0.01  # of the learning rate, where its cosine ends
MARGIN = 0.97  # of the minutes that were asked for are planned
os.umask(UMASK := os.umask(0))
ANCHOR_POINTS = 2048  # of a step
TIMED = 20  # steps whose time the plan rests on

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
class Data:
    """Clouds (S, M, 3), normalised, on the training device. pairs: labelled sources and targets (S, M, 3), or None."""

    train: Tensor
    held_out: Tensor
    pairs: tuple[Tensor, Tensor] | None = None
    described: list[str] = field(default_factory=list)  # for the card


@dataclass
class Progress:
    """Where the run is. best is the epoch whose weights model.safetensors holds; 0 is the start."""

    step: int = 0
    steps: int = 0
    epoch: int = 0
    best: int = 0
    seconds: float = 0.0
    scores: dict[str, dict[str, list[float]]] = field(default_factory=dict)  # epoch -> setting -> [success, median]


@dataclass
class Report:
    """What a step (or, with ``row``, an epoch) has to say. left: seconds, estimated."""

    step: int
    steps: int
    loss: float
    samples_per_second: float
    left: float
    row: dict[str, Any] | None = None


class Trainer:
    """One run in a folder. ``run`` yields a Report a step and an epoch; what it leaves is in the folder at any time."""

    def __init__(
        self, recipe: Recipe, data: Data, out: Path, start: tuple[Encoder, dict[str, Tensor]] | None,
        minutes: float | None = None, resume: bool = False,
    ) -> None:  # fmt: skip
        self.recipe, self.data, self.out, self.minutes = recipe, data, out, minutes
        self.device = data.train.device
        self.rank, self.world = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        torch.manual_seed(recipe.seed)
        decoder_weights: dict[str, Tensor] = {}
        if start is None:
            encoder = Encoder(recipe.feature_dim, recipe.hidden)
        else:
            encoder, decoder_weights = start
            encoder = encoder.requires_grad_(True)
        self.encoder = encoder.train().to(self.device)
        self.anchors = draw_anchors(self.encoder.feature_dim, torch.Generator(self.device).manual_seed(recipe.seed))
        self.decoder = None
        self.warm = recipe.anchor_steps  # the first step in which the paper's losses may change the encoder
        if recipe.chamfer_weight > 0:
            self.decoder = Decoder(encoder.feature_dim, recipe.points).to(self.device)
            try:
                self.decoder.load_state_dict(decoder_weights)
            except RuntimeError:  # none in the file, or for another number of points: a new one
                self.warm += recipe.decoder_warmup if start is not None or recipe.anchor_steps else 0
        self.parameters = [*self.encoder.parameters(), *(self.decoder.parameters() if self.decoder else [])]
        self.optimiser = torch.optim.Adam(self.parameters, recipe.learning_rate)
        self.progress = Progress(steps=recipe.steps)
        self.planned = minutes is None
        if resume:
            self.restore()

    # -- one step ------------------------------------------------------------------------------------------------------

    def loss(self, step: int) -> dict[str, Tensor]:
        """The losses of a step, those that it has."""
        recipe = self.recipe
        generator = torch.Generator(self.device).manual_seed(hash((recipe.seed, step, self.rank)) % 2**63)
        if step < recipe.anchor_steps:
            return {"anchors": anchor_loss(self.encoder, self.anchors, recipe.anchor_width, ANCHOR_POINTS, generator)}
        share = (step - recipe.anchor_steps) / max(self.progress.steps - recipe.anchor_steps, 1)
        losses = {}
        if self.decoder and share <= recipe.chamfer_until:
            clouds = draw_clouds(self.data.train, recipe.chamfer_batch, generator)
            seen, whole = clouds[:, : recipe.points], clouds[:, -recipe.points :]
            with torch.set_grad_enabled(step >= self.warm):
                code = encode(self.encoder, seen).feature
            losses["chamfer"] = recipe.chamfer_weight * chamfer(self.decoder(code), whole).mean()
        if recipe.pose_weight > 0 and step >= self.warm and share >= recipe.pose_after:
            plain = float(torch.rand((), generator=generator, device=self.device)) < recipe.plain
            full = replace(recipe.augment, rotation=recipe.plain_rotation, overlap=1.0)
            pairs = self.draw(full if plain else recipe.augment, generator)
            error = pose_loss(self.encoder, pairs.source, pairs.target, pairs.truth, recipe.unroll, not plain)
            losses["pose"] = recipe.pose_weight * error
        return losses

    def draw(self, augment: Augment, generator: torch.Generator) -> Pairs:
        """The pairs of a step: synthetic ones, and every other step labelled ones where there are any."""
        recipe = self.recipe
        if self.data.pairs is None or float(torch.rand((), generator=generator, device=self.device)) < 0.5:
            return draw_pairs(self.data.train, recipe.pose_batch, recipe.points, augment, generator)
        sources, targets = self.data.pairs
        index = torch.randint(len(sources), (recipe.pose_batch,), generator=generator, device=self.device)
        turn = random_rotations(recipe.pose_batch, generator)
        order = torch.rand(sources.shape[1], generator=generator, device=self.device).argsort()[: recipe.points]
        source, target = ((x[index][:, order] @ turn) for x in (sources, targets))
        spread = torch.rand(3, recipe.pose_batch, generator=generator, device=self.device)
        truth = random_motions(augment.rotation * spread[0], augment.shift * spread[1], generator)
        sigma = augment.noise * spread[2].square()
        return make_pairs(source, target, truth, sigma, augment.centre, 0 * sigma, generator)

    def step(self) -> dict[str, float]:
        """One step of Adam; the value of each loss. Raises TrainingError where one is not finite."""
        done = self.progress.step
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate(done)
        losses = self.loss(done)
        self.optimiser.zero_grad(set_to_none=True)
        total = sum(losses.values(), torch.zeros((), device=self.device))
        if losses:
            total.backward()
            self.average_gradients()
        values = {name: float(value.detach()) for name, value in losses.items()}
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.recipe.clip)
        if not math.isfinite(sum(values.values())):
            kept = (
                f"{self.out / MODEL} holds the best weights before that" if self.progress.epoch else "nothing is lost"
            )
            raise TrainingError(f"the loss is not finite at step {done}; {kept}; lower the learning rate")
        if bool(torch.isfinite(norm)):  # a single ill-posed pair must not end a run; its step is left out
            self.optimiser.step()
        self.progress.step += 1
        return values

    def rate(self, step: int) -> float:
        """The learning rate: a ramp, then half a cosine; for the anchors, then for the steps that are left."""
        first, last, rate = 0, self.recipe.anchor_steps, self.recipe.anchor_rate
        if step >= last:
            first, last, rate = self.warm, self.progress.steps, self.recipe.learning_rate
        if step < first:
            return 1e-3  # the decoder alone
        done, steps = step - first, max(last - first, 1)
        cosine = LAST_RATE + (1 - LAST_RATE) * (1 + math.cos(math.pi * min(done / steps, 1))) / 2
        return rate * min(1.0, (done + 1) / RAMP) * cosine

    def average_gradients(self) -> None:
        if self.world > 1:
            gradients = [p.grad for p in self.parameters if p.grad is not None]
            flat = torch.cat([g.flatten() for g in gradients])
            dist.all_reduce(flat)
            flat /= self.world
            for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
                gradient.copy_(mean.view_as(gradient))

    def agreed(self, value: float) -> float:
        """The first process's value, in every process."""
        if self.world == 1:
            return value
        shared = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.broadcast(shared, 0)
        return float(shared)

    # -- the run -------------------------------------------------------------------------------------------------------

    def run(self) -> Iterator[Report]:
        """Trains to the recipe's last step, or as far as the minutes go."""
        recipe, progress = self.recipe, self.progress
        started = time.monotonic() - progress.seconds
        if not progress.scores:
            row = self.test({})
            yield self.report(row, 0.0, 0.0, started)
        test_seconds = time.monotonic() - started
        seen: dict[str, list[float]] = {}  # a loss is missing in the steps before it sets in
        first, epoch_start, counted = time.monotonic(), time.monotonic(), 0
        timed_from = progress.step
        while progress.step < progress.steps:
            values = self.step()
            counted += 1
            for name, value in values.items():
                seen.setdefault(name, []).append(value)
            if not self.planned and progress.step - timed_from == TIMED:
                self.plan((time.monotonic() - first) / TIMED, test_seconds, time.monotonic() - started)
            late = bool(self.agreed(self.minutes is not None and time.monotonic() - started > 60 * self.minutes))
            if progress.step % recipe.epoch_steps == 0 or progress.step == progress.steps or late:
                progress.seconds = time.monotonic() - started
                seconds = time.monotonic() - epoch_start
                means = {name: float(np.mean(value)) for name, value in seen.items()}
                row = self.test(means)
                yield self.report(row, sum(means.values()), seconds / counted, started)
                seen, counted, epoch_start = {}, 0, time.monotonic()
                if late:
                    break
            else:
                each = (time.monotonic() - epoch_start) / counted
                yield self.report(None, sum(values.values()), each, started)

    def plan(self, step_seconds: float, test_seconds: float, spent: float) -> None:
        """Fits the number of steps, and with it the learning rate's cosine, into the minutes."""
        assert self.minutes is not None
        left = MARGIN * 60 * self.minutes - spent
        each = step_seconds + test_seconds / self.recipe.epoch_steps
        steps = self.progress.step + max(int(left / each), 1)
        self.progress.steps = int(self.agreed(min(steps, self.recipe.steps)))
        self.planned = True
        self.recipe = self.recipe.changed(steps=self.progress.steps)
        if self.rank == 0:
            self.write(RECIPE, lambda path: path.write_text(self.recipe.toml()))

    def report(self, row: dict[str, Any] | None, loss: float, each: float, started: float) -> Report:
        progress, recipe = self.progress, self.recipe
        clouds = self.world * (
            (recipe.chamfer_weight > 0) * recipe.chamfer_batch + (recipe.pose_weight > 0) * recipe.pose_batch
        )
        left = each * (progress.steps - progress.step)
        if self.minutes is not None:
            left = (
                min(left, max(60 * self.minutes - (time.monotonic() - started), 0.0))
                if self.planned
                else 60 * self.minutes
            )
        return Report(progress.step, progress.steps, loss, clouds / each if each else 0.0, left, row)

    def test(self, losses: dict[str, float]) -> dict[str, Any]:
        """Registers the held-out clouds, keeps the weights where they are the best so far, writes metrics and state."""
        progress, row = self.progress, {}
        if self.rank == 0:
            found = score(self.encoder, self.data.held_out, HARD, self.recipe.held_out_pairs, 512)
            progress.scores[str(progress.epoch)] = {
                name: [e.success, e.median, float(np.minimum(e.rotation, 30).mean())] for name, e in found.items()
            }
            # While anchors are learnt there is nothing to choose: the paper's losses are yet to come.
            early = progress.step <= self.recipe.anchor_steps
            if early or self.quality(progress.epoch) > self.quality(progress.best):
                progress.best = progress.epoch
                self.write(MODEL, lambda path: save_encoder(path, self.encoder, self.decoder))
            row = {"epoch": progress.epoch, "step": progress.step, "seconds": round(progress.seconds, 1),
                   **{f"loss_{name}": value for name, value in losses.items()},
                   "success": self.mean_success(progress.epoch),
                   **{f"{name}: {what}": value for name, e in found.items()
                      for what, value in (("success", e.success), ("median deg", e.median))}}  # fmt: skip
            self.write_metrics(row)
            progress.epoch += 1
            self.save()
        if self.world > 1:
            dist.barrier()
            progress.epoch += self.rank > 0
        return row

    def mean_success(self, epoch: int) -> float:
        return float(np.mean([success for success, _, _ in self.progress.scores[str(epoch)].values()]))

    def quality(self, epoch: int) -> tuple[float, float]:
        """What the best is chosen by: mean success over the settings, then the mean error (each at most 30 deg)."""
        return self.mean_success(epoch), -float(np.mean([e for _, _, e in self.progress.scores[str(epoch)].values()]))

    # -- files ---------------------------------------------------------------------------------------------------------

    def write(self, name: str, save: Any) -> None:
        """Writes a file of the run atomically; the weights library's own error for a full disk becomes an OSError's."""
        from safetensors import SafetensorError

        with atomic_write(self.out / name) as temporary:
            try:
                save(temporary)
            except SafetensorError as error:
                raise OSError(str(error)) from None
            os.chmod(temporary, 0o666 & ~UMASK)  # safetensors makes files that only their owner can read

    def write_metrics(self, row: dict[str, Any]) -> None:
        """One more row, in a file that is whole at any time; rows from after a resumed state go."""
        path = self.out / METRICS
        old = list(csv.DictReader(io.StringIO(path.read_text()))) if path.is_file() and row["epoch"] else []
        rows = [r for r in old if int(r["epoch"]) < row["epoch"]] + [row]
        text = io.StringIO()
        names = list(dict.fromkeys(name for r in rows for name in r))
        table = csv.DictWriter(text, names, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        self.write(METRICS, lambda temporary: temporary.write_text(text.getvalue()))

    def save(self) -> None:
        """Everything that the next step depends on, in one file."""
        from safetensors.torch import save_file

        tensors = {
            f"{kind}.{name}": value for kind, module in self.modules() for name, value in module.state_dict().items()
        }
        for i, parameter in enumerate(self.parameters):
            tensors |= {f"adam.{i}.{k}": v for k, v in self.optimiser.state.get(parameter, {}).items()}
        held = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        metadata = {
            "progress": json.dumps(asdict(self.progress)),
            "recipe": self.recipe.toml(),
            "planned": json.dumps(self.planned),
        }
        self.write(STATE, lambda path: save_file(held, str(path), metadata=metadata))

    def modules(self) -> list[tuple[str, torch.nn.Module]]:
        return [("encoder", self.encoder), *([("decoder", self.decoder)] if self.decoder else [])]

    def restore(self) -> None:
        """Takes the run up where its last state was written. Raises ModelError where the state does not fit."""
        from safetensors import SafetensorError, safe_open

        path = self.out / STATE
        try:
            with safe_open(str(path), "pt", device=str(self.device)) as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            for kind, module in self.modules():
                own = {n.removeprefix(f"{kind}."): v for n, v in tensors.items() if n.startswith(f"{kind}.")}
                module.load_state_dict(own)
            for i, parameter in enumerate(self.parameters):
                own = {n.split(".", 2)[2]: v for n, v in tensors.items() if n.startswith(f"adam.{i}.")}
                if own:
                    self.optimiser.state[parameter] = own
            self.progress = Progress(**json.loads(metadata["progress"]))
            self.planned = json.loads(metadata["planned"]) or self.minutes is None
        except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise ModelError(f"{path}: no state to resume ({reason}); run without --resume") from None


def saved_recipe(out: Path) -> Recipe:
    """The recipe of a run that is to be resumed. Raises FmrError where the folder holds none."""
    if not (out / STATE).is_file():
        raise TrainingError(f"{out}: holds no {STATE}, so there is no run to resume; run without --resume")
    return read_recipe(out / RECIPE)


def read_start(name: str) -> tuple[Encoder, dict[str, Tensor]] | None:
    """The weights to start from: "scratch" is None, "base" the bundled ones, else a file. Raises ModelError."""
    from fmr_cli.registration.models import bundled_path

    if name == "scratch":
        return None
    if name == "base":
        with bundled_path() as path:
            return load_weights(path)
    return load_weights(Path(name))


def join_processes(device: torch.device) -> torch.device:
    """Under torchrun, joins the other processes and takes this one's GPU; alone, nothing."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not dist.is_initialized():
        if device.type == "cuda":
            device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return device


def success_table(trainer: Trainer) -> list[tuple[str, list[float], list[float]]]:
    """(setting, [success, median degrees] at the start, the same at the best) for every setting."""
    scores, best = trainer.progress.scores, str(trainer.progress.best)
    return [(name, scores["0"][name][:2], scores[best][name][:2]) for name in scores["0"]]
