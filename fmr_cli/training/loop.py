"""The training loop: steps, a held-out test an epoch, the best kept, a state from which a killed run goes on exactly.

Every random number of a step follows from (seed, step, rank), so that the state needs no generator's.
Under torchrun every process takes its own batches, gradients are averaged, and the first process tests and writes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fmr_cli.training.processes import agreed, average_gradients, rank_and_world, wait_for_all
from fmr_cli.training.run_folder import MODEL, RECIPE, Progress, RunFolder, TrainingError, parameters
from fmr_cli.training.task import Show, Task

MARGIN = 0.97  # of the minutes that were asked for are planned: the last test and the card take the rest
TIMED = 20  # steps whose time the plan rests on: some seconds, over which a shared machine's speed evens out


@dataclass
class Report:
    """What a step (or, with ``row``, an epoch) has to say. left: seconds, estimated. notes: for a person."""

    step: int
    steps: int
    loss: float
    clouds_per_second: float
    left: float
    row: dict[str, Any] | None = None
    notes: list[str] = field(default_factory=list)


@dataclass
class Epoch:
    """The steps since the last test: their losses, and how long they take."""

    begin: float = field(default_factory=time.monotonic)
    steps: int = 0
    losses: dict[str, list[float]] = field(default_factory=dict)  # one is missing in the steps before it sets in

    def add(self, losses: dict[str, float]) -> None:
        self.steps += 1
        for name, value in losses.items():
            self.losses.setdefault(name, []).append(value)

    def means(self) -> dict[str, float]:
        """Of each loss, over the steps that had it."""
        return {name: float(np.mean(values)) for name, values in self.losses.items()}

    def step_seconds(self) -> float:
        return (time.monotonic() - self.begin) / self.steps if self.steps else 0.0


class Trainer:
    """One run in a folder. ``run`` yields a Report a step and an epoch; what it leaves is in the folder at any time."""

    def __init__(self, task: Task, out: Path, minutes: float | None = None, resume: bool = False) -> None:
        """minutes: as many steps as fit into them. resume: go on from the state in ``out``; raises ModelError."""
        self.task, self.recipe, self.device = task, task.recipe, task.device
        self.folder, self.minutes = RunFolder(out), minutes
        self.rank, self.world = rank_and_world()
        learnt = [p for module in task.modules.values() for p in module.parameters()]
        self.optimiser = torch.optim.Adam(learnt, self.recipe.learning_rate)
        self.progress = Progress(steps=self.recipe.steps, planned=minutes is None)
        if resume:
            self.progress = self.folder.load_state(task.modules, self.optimiser, self.device)
            self.progress.planned |= minutes is None
        self.begin = time.monotonic()
        self.test_seconds = self.renewal_seconds = 0.0  # that the last test and the last renewal took
        self.show: Show = lambda what, done, total: None

    def spent(self) -> float:
        """Seconds of training, those before a resumed state as well."""
        return time.monotonic() - self.begin

    def run(self) -> Iterator[Report]:
        """Trains to the recipe's last step, or as far as the minutes go, and checks what is kept."""
        progress = self.progress
        self.begin = time.monotonic() - progress.seconds
        yield from self.renew()
        if not progress.scores:
            yield self.report(0.0, Epoch(), self.test({}))
        self.task.start_scores = progress.scores.get("0", {})
        epoch, timed = Epoch(), Epoch()
        while progress.step < progress.steps:
            values = self.step()
            epoch.add(values)
            timed.add({})
            if not progress.planned and timed.steps == TIMED:
                self.plan(timed.step_seconds())
            late = bool(agreed(self.minutes is not None and self.spent() > self.training_seconds(), self.device))
            if progress.step % self.recipe.epoch_steps and progress.step < progress.steps and not late:
                yield self.report(sum(values.values()), epoch)
            else:
                means = epoch.means()
                yield self.report(sum(means.values()), epoch, self.test(means))
                epoch = Epoch()
            if late:
                break
            if progress.step < progress.steps:
                yield from self.renew(epoch)
        yield from self.check()

    def renew(self, epoch: Epoch | None = None) -> Iterator[Report]:
        """Lets the task gather more to learn from; an epoch's time does not count that."""
        begin = time.monotonic()
        notes = self.task.renew(self.progress.step, self.progress.steps, self.folder, self.show)
        if notes:
            self.renewal_seconds = time.monotonic() - begin
            if epoch is not None:
                epoch.begin += self.renewal_seconds
            yield self.report(0.0, epoch or Epoch(), notes=notes)

    def check(self) -> Iterator[Report]:
        """The task's last test of what is kept, once."""
        if self.progress.check is None:
            if self.rank == 0:
                seconds = None if self.minutes is None else max(60 * self.minutes - self.spent(), 0.0)
                self.progress.check = self.task.check(self.folder, seconds, self.show)
                self.progress.seconds = self.spent()
                if self.progress.check is not None:
                    self.save()
                    yield self.report(0.0, Epoch(), notes=self.progress.check["said"])
            wait_for_all()

    def training_seconds(self) -> float:
        """How long training may take of the minutes."""
        assert self.minutes is not None
        return 60 * self.minutes - self.task.closing_seconds(self.minutes)

    def step(self) -> dict[str, float]:
        """One step of Adam; the value of each loss. Raises TrainingError where one is not finite."""
        done, steps = self.progress.step, self.progress.steps
        learnt = parameters(self.optimiser)
        for group in self.optimiser.param_groups:
            group["lr"] = self.task.rate(done, steps)
        generator = torch.Generator(self.device).manual_seed(step_seed(self.recipe.seed, done, self.rank))
        losses = self.task.losses(done, steps, generator)
        self.optimiser.zero_grad(set_to_none=True)
        if losses:
            torch.stack(list(losses.values())).sum().backward()  # type: ignore[no-untyped-call]
            average_gradients(learnt)
        values = {name: float(value.detach()) for name, value in losses.items()}
        norm = torch.nn.utils.clip_grad_norm_(learnt, self.task.clip)
        if not math.isfinite(sum(values.values())):
            best = f"{self.folder.path / MODEL} holds the best weights before that"
            kept = best if self.progress.epoch else "nothing is lost"
            raise TrainingError(f"the loss is not finite at step {done}; {kept}; lower the learning rate")
        if bool(torch.isfinite(norm)):  # a single ill-posed pair must not end a run; its step is left out
            self.optimiser.step()
        self.progress.step += 1
        return values

    def plan(self, step_seconds: float) -> None:
        """Fits the number of steps, and with it the learning rate's cosine, and of renewals into the minutes."""
        assert self.minutes is not None
        left = agreed(MARGIN * self.training_seconds() - self.spent(), self.device)
        renewal = agreed(self.renewal_seconds, self.device)
        changes = self.task.fit_renewals(left, renewal)
        left -= self.task.renewals() * renewal
        each = step_seconds + self.test_seconds / self.recipe.epoch_steps
        steps = self.progress.step + max(int(left / each), 1)
        self.progress.steps = int(agreed(min(steps, self.recipe.steps), self.device))
        self.progress.planned = True
        self.recipe = self.recipe.changed(steps=self.progress.steps, **changes)
        if self.rank == 0:
            self.folder.write(RECIPE, self.recipe.toml())

    def report(
        self, loss: float, epoch: Epoch, row: dict[str, Any] | None = None, notes: list[str] | None = None
    ) -> Report:
        """What there is to say after a step, or after an epoch, whose figures are ``row``."""
        progress, each = self.progress, epoch.step_seconds()
        left = each * (progress.steps - progress.step)
        if self.minutes is not None:
            in_time = max(60 * self.minutes - self.spent(), 0.0)
            left = min(left, in_time) if progress.planned else in_time
        speed = self.world * self.task.clouds / each if each else 0.0
        return Report(progress.step, progress.steps, loss, speed, left, row, notes or [])

    def test(self, losses: dict[str, float]) -> dict[str, Any]:
        """Tests on what is held out, keeps the weights where they are the best so far, writes metrics and state."""
        progress, row = self.progress, {}
        begin = time.monotonic()
        progress.seconds = self.spent()
        if self.rank == 0:
            scores = self.task.test()
            progress.scores[str(progress.epoch)] = scores
            self.task.start_scores = progress.scores["0"]
            early = progress.epoch == 0 or not self.task.may_choose(progress.step)
            if early or self.quality(progress.epoch) > self.quality(progress.best):
                progress.best = progress.epoch
                self.folder.write(MODEL, self.task.weights())
            row = {"epoch": progress.epoch, "step": progress.step, "seconds": round(progress.seconds, 1),
                   **{f"loss_{name}": value for name, value in losses.items()},
                   "success": self.quality(progress.epoch)[0],
                   **{f"{setting}: {what}": value for setting, measures in scores.items()
                      for what, value in measures.items()}}  # fmt: skip
            self.folder.add_metrics(row)
            progress.epoch += 1
            self.save()
        wait_for_all()
        progress.epoch += self.rank > 0
        self.test_seconds = time.monotonic() - begin
        return row

    def save(self) -> None:
        """Everything that the next step depends on."""
        self.folder.save_state(self.task.modules, self.optimiser, self.progress, self.recipe.toml())

    def quality(self, epoch: int) -> tuple[float, ...]:
        """What the best epoch is chosen by."""
        return self.task.quality(self.progress.scores[str(epoch)])


def step_seed(seed: int, step: int, rank: int) -> int:
    """The seed of a step's generator in one process; numpy's mixing, the same on every platform and version."""
    return int(np.random.SeedSequence((seed, step, rank)).generate_state(1, np.uint64)[0])
