"""All experiments of `fmr evaluate --experiments`, and the groups that one name stands for."""

from __future__ import annotations

from typing import Any

from fmr_cli.evaluation import cross_source, experiments, last_step
from fmr_cli.evaluation.experiments import Experiment

PAPER = tuple(experiments.EXPERIMENTS)
EXPERIMENTS: dict[str, Experiment[Any]] = {
    **experiments.EXPERIMENTS,
    **last_step.EXPERIMENTS,
    **cross_source.EXPERIMENTS,
}
GROUPS = {"refine": tuple(last_step.EXPERIMENTS)}
