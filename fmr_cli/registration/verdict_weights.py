"""What the verdict has learnt: the weights of its evidence, the bundled ones or those of a model file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Weights:
    """What the fit gives. support: (d,) of ``Evidence.vector``; fit: (q,) of ``Evidence.quality``.

    mean, std: (s,) of ``standing`` where it was fitted; verdict: (1 + s + s (s + 1) / 2,) of its ``products``.
    """

    support: np.ndarray
    fit: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    verdict: np.ndarray

    def shapes(self) -> list[tuple[int, ...]]:
        """Which evidence they weigh: those of another version have other shapes."""
        return [getattr(self, f.name).shape for f in fields(self)]


def as_weights(given: Mapping[str, Any]) -> Weights:
    """Those of a JSON object. Raises KeyError where it lacks some."""
    return Weights(**{f.name: np.array(given[f.name]) for f in fields(Weights)})


@cache
def bundled_weights() -> Weights:
    """Those of ``models/verdict.json``."""
    return as_weights(json.loads((files("fmr_cli.models") / "verdict.json").read_text("utf-8")))


def usable(given: Mapping[str, Any] | None) -> Weights:
    """Those that a model file brings along; the bundled ones where it has none, or those of another version."""
    bundled = bundled_weights()
    try:
        own = bundled if given is None else as_weights(given)
    except KeyError:
        return bundled
    return own if own.shapes() == bundled.shapes() else bundled
