"""Scans that have one frame, and what may join two such components."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from fmr_cli.multiway.parts import parts

JOINED = 0.5  # probability from which scans are joined, if one link is sure by itself, or views vouch for it


@dataclass
class Component:
    """Scans with one frame. T_component_scan: by scan, between centred frames. held: scans that don't move."""

    T_component_scan: dict[int, np.ndarray]
    held: set[int] = field(default_factory=set)


@dataclass(frozen=True)
class Join:
    """A pose between two components. probability: that it is right; against: the probability of the best rival.

    links: that agree on it, by number; denied: how many deny it; sound: one is sure by itself, or views vouch for it.
    """

    T_second_first: np.ndarray
    log_odds: float
    probability: float
    against: float
    links: tuple[int, ...]
    denied: int
    sound: bool

    @property
    def holds(self) -> bool:
        """Whether scans are joined by it: doubtful links never do so alone, however many agree."""
        return self.sound and self.probability >= JOINED


def homes(component: Component, ends: Iterable[tuple[int, int]]) -> dict[int, int]:
    """The part of a component that each scan is in, if links join so many pairs; scans that don't move are in one."""
    held = sorted(component.held)
    return parts(component.T_component_scan, [*pairwise(held), *ends])
