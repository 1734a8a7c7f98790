"""What a run trains, as the loop sees it: losses, a learning rate, a held-out test, and how its figures read."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from fmr_cli.training.recipe import AnyRecipe

Scores = dict[str, dict[str, float]]  # setting -> measure -> value
Show = Callable[[str, int, int], None]  # what is going on, how much of it is done, of how much

RAMP = 100  # steps over which the learning rate rises from zero: Adam's second moments have settled by then
LAST_RATE = 0.01  # of the learning rate, where its cosine ends


class Files(Protocol):
    """The folder of a run, as a task sees it."""

    @property
    def path(self) -> Path: ...

    def write(self, name: str, content: str | bytes) -> None: ...


class Task(ABC):
    """One kind of training.

    modules: what is trained, by the names that the state uses. described: what it learns from, for the card.
    clouds: a step's, for the speed. clip: the largest norm of the gradient. measure: the first value of ``quality``,
    measured: what the table of scores shows, in words.
    """

    recipe: AnyRecipe
    modules: dict[str, nn.Module]
    described: list[str]
    device: torch.device
    clouds: int
    clip: float
    measure: str
    measured: str
    start_scores: Scores = {}  # noqa: RUF012 (replaced, never changed)

    def renew(self, step: int, steps: int, files: Files, show: Show) -> list[str]:
        """Gathers what the steps from ``step`` on learn from, where there is more to be had by now; says what."""
        return []

    def closing_seconds(self, minutes: float) -> float:
        """Of a run of so many minutes, what ``check`` may take."""
        return 0.0

    def renewals(self) -> int:
        """How often ``renew`` will do so again."""
        return 0

    def fit_renewals(self, seconds: float, each: float) -> dict[str, int]:
        """Renews no more often than suits a run with so many seconds left, of which each time takes ``each``.

        Returns what this changes of the recipe.
        """
        return {}

    def check(self, files: Files, seconds: float | None, show: Show) -> dict[str, Any] | None:
        """A last test of the model that is kept, which may replace it; its figures, or None where there is none."""
        return None

    @abstractmethod
    def losses(self, step: int, steps: int, generator: torch.Generator) -> dict[str, Tensor]:
        """The losses of a step of ``steps``, those that it has; every random number is the generator's."""

    @abstractmethod
    def rate(self, step: int, steps: int) -> float:
        """The learning rate of a step."""

    @abstractmethod
    def test(self) -> Scores:
        """How good the weights are on what is held out."""

    @abstractmethod
    def quality(self, scores: Scores) -> tuple[float, ...]:
        """What the best epoch is chosen by, larger is better; the first is a share, ``measure``."""

    @abstractmethod
    def may_choose(self, step: int) -> bool:
        """Whether the best may be chosen by its quality yet; before that, the latest weights are kept."""

    @abstractmethod
    def weights(self) -> bytes:
        """The model file."""

    @abstractmethod
    def shown(self, scores: dict[str, float]) -> str:
        """A setting's scores, in a cell of that table."""

    @abstractmethod
    def gain(self, before: Scores, after: Scores) -> str:
        """What else than ``measure`` changed, in words; may be empty."""

    @abstractmethod
    def card(self) -> list[str]:
        """Lines of the model's card: what the weights are for, what they were made from and how."""


def ramped_cosine(step: int, first: int, last: int, rate: float, ramp: int = RAMP) -> float:
    """The learning rate: a ramp of so many steps from ``first``, times half a cosine that ends at ``last``."""
    done, steps = step - first, max(last - first, 1)
    cosine = LAST_RATE + (1 - LAST_RATE) * (1 + math.cos(math.pi * min(done / steps, 1))) / 2
    return rate * min(1.0, (done + 1) / ramp) * cosine
