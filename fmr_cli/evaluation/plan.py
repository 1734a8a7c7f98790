"""What `fmr evaluate` measures, as small tasks that any worker can do; each worker makes methods and data once."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from fmr_cli.errors import FmrError
from fmr_cli.evaluation import benchmark, cross_source, experiments, last_step
from fmr_cli.evaluation.benchmark import Outcome, failed, outcomes
from fmr_cli.evaluation.catalogue import EXPERIMENTS
from fmr_cli.evaluation.datasets import read_dataset
from fmr_cli.evaluation.datasets.pair import DataSet
from fmr_cli.evaluation.experiments import Clouds, Experiment, Row, read_clouds
from fmr_cli.evaluation.methods import Method, baselines, ours, product
from fmr_cli.registration.models import Device, encoder, fast_encoder, pick_device
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import one_blas_thread
from fmr_cli.synthetic.cross_source import SENSORS
from fmr_cli.workers import Workers
from fmr_cli.workers.base import LostError, UnfitError, kept

Made = TypeVar("Made")


@dataclass(frozen=True)
class Compared:
    """Which methods. models: weights; none: the bundled ones. threads: of one pair."""

    models: tuple[Path, ...] = ()
    align: bool = True
    baselines: bool = False
    plain: bool = True
    iterations: int = 10
    seed: int = 0
    threads: int = 1
    device: Device = "auto"


@dataclass(frozen=True)
class OnDataset:
    """The methods on the pairs of a data set. name, paths: as ``read_dataset``; pairs: at most so many of them."""

    name: str
    paths: tuple[Path, ...]
    compared: Compared
    pairs: int | None = None

    def made(self) -> tuple[DataSet, dict[str, benchmark.Method], list[str]]:
        """The data set, the methods by the name in the tables, a line for each method that cannot run here."""
        return kept(repr(self), self._make)

    def _make(self) -> tuple[DataSet, dict[str, benchmark.Method], list[str]]:
        what, found, lines = self.compared, {}, []
        data = read_dataset(self.name, self.paths, what.seed).thinned(self.pairs)
        for number, path in enumerate(what.models or [None]):
            own, missing = benchmark.methods(
                data, Options(model=path, seed=what.seed), fast_encoder(path), what.iterations, what.plain,
                what.baselines and not number, what.threads,
            )  # fmt: skip
            lines += missing
            for name, method in own.items():
                if what.align or not name.startswith("fmr align"):
                    found[name if path is None or "small_gicp" in name else f"{name}, {path}"] = method
        return data, found, lines

    def outcomes(self, number: int) -> list[Outcome]:
        """Every method on the pair with that number."""
        data, methods, _ = on_worker(self.made)
        with one_blas_thread():  # a product's last bits depend on how many threads share it
            return outcomes(data.pairs[number], data, methods)

    def run(self, team: Workers) -> Generator[list[Outcome], None, None]:
        """A row a method for each pair, in the pairs' order. No pair ends the others."""
        data, methods, _ = self.made()
        answers = team.run(self.outcomes, range(len(data.pairs)))
        try:
            for pair, done in zip(data.pairs, answers, strict=True):
                lost = isinstance(done, LostError)
                yield [failed(pair, name, str(done)) for name in methods] if lost else done
        finally:
            answers.close()


@dataclass(frozen=True)
class OnScans:
    """The paper's experiments on folders of scans. clouds: of each folder, at most; pairs: at each level."""

    paths: tuple[Path, ...]
    compared: Compared
    clouds: int | None
    pairs: int
    points: int

    def made(self) -> tuple[list[Clouds], dict[str, Method], list[str]]:
        """The sets of clouds, the methods by the name in the tables, a line for each method that cannot run here."""
        return kept(repr(self), self._make)

    def _make(self) -> tuple[list[Clouds], dict[str, Method], list[str]]:
        what, lines = self.compared, list[str]()
        methods: dict[str, Method] = {"fmr align": product()} if what.align else {}
        for path in what.models or [None]:
            name, weights = str(path or "bundled"), encoder(path, what.device)
            methods[name] = ours(weights, what.iterations, True)
            if what.plain:
                methods[f"{name}, plain"] = ours(weights, what.iterations, False)
        if what.baselines:
            others, lines = baselines(what.device, what.iterations)
            methods |= others
        device = pick_device(what.device)
        return [read_clouds(path, self.clouds, self.points, device) for path in self.paths], methods, lines

    def rows(self, task: tuple[str, int, int]) -> list[Row]:
        """Every method at one level: (experiment, number of the set, number of the level)."""
        name, place, level = task
        sets, methods, _ = on_worker(self.made)
        if self.compared.threads == 1:
            torch.set_num_threads(1)
        return experiments.at_level(
            EXPERIMENTS[name], level, sets[place], methods, self.pairs, self.points, self.compared.seed
        )

    def run(self, experiment: Experiment[Any], team: Workers) -> Generator[list[Row], None, None]:
        """The rows of an experiment, set by set and level by level."""
        return level_by_level(self.rows, experiment, len(self.paths), team)


@dataclass(frozen=True)
class OnPairsOfItsOwn:
    """The experiments that make their pairs: last steps from near starts, and cross-source pairs.

    The former on the scans, without any on made-up ones; the latter always made up. As ``OnScans``; points: None for
    what suits the experiment.
    """

    paths: tuple[Path, ...]
    clouds: int | None
    pairs: int
    points: int | None
    seed: int

    @property
    def size(self) -> int:
        """Points of each cloud."""
        return self.points or last_step.POINTS

    def made(self) -> list[Clouds]:
        """The sets of clouds that are given."""
        return kept(repr(self), self._make)

    def _make(self) -> list[Clouds]:
        return [read_clouds(path, self.clouds, self.size, torch.device("cpu")) for path in self.paths]

    def sets(self, experiment: Experiment[Any]) -> int:
        """How many sets of pairs an experiment has."""
        return len(SENSORS) if experiment.name in cross_source.EXPERIMENTS else max(len(self.paths), 1)

    def rows(self, task: tuple[str, int, int]) -> list[Row]:
        """Every method at one level: (experiment, number of the set, number of the level)."""
        name, place, level = task
        with one_blas_thread():
            if name in cross_source.EXPERIMENTS:
                return cross_source.at_level(EXPERIMENTS[name], level, place, self.pairs, self.seed)
            sets = on_worker(self.made)
            clouds = sets[place] if sets else None
            return last_step.at_level(EXPERIMENTS[name], level, clouds, self.pairs, self.size, self.seed)

    def run(self, experiment: Experiment[Any], team: Workers) -> Generator[list[Row], None, None]:
        """The rows of an experiment, set by set and level by level."""
        return level_by_level(self.rows, experiment, self.sets(experiment), team)


def level_by_level(
    rows: Callable[[tuple[str, int, int]], list[Row]], experiment: Experiment[Any], sets: int, team: Workers
) -> Generator[list[Row], None, None]:
    """Rows of (experiment, set, level), for each set and level, by the workers. Raises what lost one of them."""
    for done in team.run(
        rows, [(experiment.name, n, level) for n in range(sets) for level in range(len(experiment.levels))]
    ):
        if isinstance(done, LostError):
            raise done
        yield done


def on_worker(make: Callable[[], Made]) -> Made:
    """What could be made where the run was started; a worker that cannot is not fit for it."""
    try:
        return make()
    except FmrError as error:
        raise UnfitError(str(error)) from None


def absolute(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Paths that mean the same on every worker."""
    return tuple(path.absolute() for path in paths)
