"""A training run from files to a folder: its settings, a trainer that is ready to run, and the card at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import fmr_cli
from fmr_cli.errors import FmrError
from fmr_cli.io.files import check_readable
from fmr_cli.io.folders import find_scans, natural
from fmr_cli.multiway.scans import Scan, names
from fmr_cli.registration.models import Device, pick_device
from fmr_cli.training.data import read_data
from fmr_cli.training.global_task import GlobalTask, read_start
from fmr_cli.training.local_task import LocalTask, read_local_start
from fmr_cli.training.local_views import make_material
from fmr_cli.training.loop import Trainer
from fmr_cli.training.processes import join_processes
from fmr_cli.training.recipe import AnyRecipe, LocalRecipe, Recipe, ScanRecipe, read_recipe
from fmr_cli.training.run_folder import CARD, MODEL, RECIPE, STATE, RunFolder, TrainingError
from fmr_cli.training.scan_material import ROUNDS, labelled_pairs
from fmr_cli.training.scan_task import ScanTask
from fmr_cli.training.scans import read_pairs
from fmr_cli.training.task import Task

UNBOUNDED = 10**9  # steps, where only the minutes count
DEFAULT_MINUTES = 10.0  # whose material a run takes that is bounded otherwise
MOST_FILES = 100  # that the global encoder's crops are cut from
ONLY_WHOLE = (
    'a recipe of kind "global" teaches the encoder of whole clouds alone, which `fmr align` uses last; leave --recipe '
    'away or give one of kind = "scans" to teach all of it'
)


def settings(
    path: Path | None,
    *,
    unsupervised: bool,
    semi_supervised: bool,
    resume: bool,
    minutes: float | None,
    epochs: int | None,
    **changes: Any,
) -> AnyRecipe:
    """The recipe of the file, or the defaults, with the changes made (None: no change). Raises FmrError.

    Without a file, that of learning from scans; its material suits the minutes.
    """
    if resume:
        return ScanRecipe()  # the run's own takes its place
    if unsupervised and semi_supervised:
        raise FmrError("--unsupervised has no use for poses; leave it away, or --semi-supervised and --pairs")
    if path is None and not (unsupervised or semi_supervised):
        raise FmrError("say how to learn: --unsupervised, --semi-supervised, or a --recipe")
    recipe = ScanRecipe().within(minutes or DEFAULT_MINUTES) if path is None else read_recipe(path)
    if isinstance(recipe, LocalRecipe) and (unsupervised or semi_supervised):
        raise FmrError(f'{path}: a recipe of kind "local" has a loss of its own; leave the kind of supervision away')
    whole = recipe.whole if isinstance(recipe, ScanRecipe) else recipe
    if isinstance(whole, Recipe) and unsupervised:
        changes["pose_weight"] = 0.0
        changes |= {"chamfer_weight": whole.chamfer_weight or 1.0, "chamfer_until": 1.0}
    if isinstance(whole, Recipe) and semi_supervised:
        changes["pose_weight"] = whole.pose_weight or 1.0
    if epochs is not None:
        changes["steps"] = epochs * recipe.epoch_steps
    elif minutes is not None:
        changes["steps"] = UNBOUNDED
    return recipe.changed(**changes)


def prepare(
    scans: list[Path],
    recipe: AnyRecipe,
    out: Path,
    *,
    pairs: Path | None = None,
    minutes: float | None = None,
    resume: bool = False,
    device: Device = "auto",
    progress: Callable[[int, int], None] = lambda i, n: None,
) -> tuple[Trainer, list[str]]:
    """A trainer that is ready to run in the folder ``out``, and warnings. Raises FmrError.

    resume: the recipe is that of the run in ``out``; scans and pairs must be those it was started with.
    """
    folder = RunFolder(out)
    if resume:
        recipe = folder.saved_recipe()
    elif (out / STATE).exists():
        raise TrainingError(f"{out}: holds a run already; give another --out, or --resume to go on with it")
    place = join_processes(pick_device(device))
    task, warnings = make_task(recipe, Given(scans, pairs, place, progress))
    folder.make()
    trainer = Trainer(task, out, minutes, resume)
    if trainer.rank == 0 and not resume:
        (out / ROUNDS).unlink(missing_ok=True)  # of a run that was killed before there was anything to resume
        folder.write(RECIPE, recipe.toml())
    return trainer, warnings


@dataclass(frozen=True)
class Given:
    """What a task is made from beside its recipe: scans or folders, a CSV of pairs, a device; and who hears of it."""

    scans: list[Path]
    pairs: Path | None
    device: torch.device
    progress: Callable[[int, int], None]


def make_task(recipe: AnyRecipe, given: Given) -> tuple[Task, list[str]]:
    """What the recipe trains, with its material, and warnings."""
    if isinstance(recipe, ScanRecipe):
        return scan_task(recipe, given)
    if isinstance(recipe, Recipe):
        return global_task(recipe, given)
    return local_task(recipe, given), []


def global_task(recipe: Recipe, given: Given) -> tuple[Task, list[str]]:
    """What trains the encoder of whole clouds, and warnings."""
    start = read_start(recipe.start)
    data, warnings = read_data(given.scans, recipe, given.pairs, given.device, given.progress)
    if given.scans and not recipe.shapes + recipe.scenes:
        warnings.append(ONLY_WHOLE)
    return GlobalTask(recipe, data, start), warnings


def local_task(recipe: LocalRecipe, given: Given) -> Task:
    """What trains the encoder of patches on made-up scans. Raises TrainingError where others are given."""
    if given.scans or given.pairs is not None:
        raise TrainingError('a recipe of kind "local" learns from made-up scans alone; leave SCANS and --pairs away')
    start = read_local_start(recipe.start)
    material = make_material(recipe.pairs, recipe.patches, recipe.seed, given.progress, others=recipe.others)
    return LocalTask(recipe, material, given.device, start)


def scan_task(recipe: ScanRecipe, given: Given) -> tuple[Task, list[str]]:
    """What learns from the user's scans, and warnings. Raises FmrError: no scans, a start or pairs that are none."""
    scans, pairs = given.scans, given.pairs
    if not scans and pairs is None:
        raise FmrError(
            "nothing to train on; give scans or folders of scans (also to --resume), or a recipe with shapes"
        )
    start = None if recipe.start in ("base", "scratch") else Path(recipe.start)
    read_start(recipe.start if recipe.start != "scratch" else "base")  # or says what is wrong with it
    rows = [] if pairs is None else read_pairs(pairs)
    files = [*(find_scans(scans) if scans else []), *(path for a, b, _ in rows for path in (a, b))]
    files = list(dict.fromkeys(files))
    listed = sorted((Scan(*x) for x in zip(names(files), files, strict=True)), key=lambda scan: natural(scan.name))
    for file in files if scans else []:
        check_readable(file)
    whole, warnings = None, list[str]()
    if recipe.whole_every:
        rng = np.random.default_rng((recipe.seed, 10))
        some = [files[i] for i in np.sort(rng.permutation(len(files))[:MOST_FILES])]
        data, warnings = read_data(some, recipe.whole, pairs, given.device, given.progress)
        data.described = [f"{len(data.train)} crops for the global encoder, {len(data.held_out)} held out"]
        whole = GlobalTask(recipe.whole, data, read_start(recipe.whole.start))
    labelled = labelled_pairs(rows, listed, recipe.seed)
    return ScanTask(recipe, listed, given.device, start, whole, labelled), warnings


def write_card(trainer: Trainer) -> None:
    """What the weights in the folder were made from, how, and how good they are on what was held out."""
    task, progress, out = trainer.task, trainer.progress, trainer.folder.path
    processes = f", {trainer.world} processes" if trainer.world > 1 else ""
    kept = f"epoch {progress.best} of {progress.epoch - 1}" if progress.best else "the start, as nothing was better"
    lines = [
        f"# {out.name}",
        "",
        f"Weights `{MODEL}`, written by fmr {fmr_cli.__version__}.",
        *task.card(),
        f"- Steps: {progress.step} of {progress.steps}, {progress.seconds / 60:.1f} minutes on {trainer.device.type}"
        f"{processes}. All settings: `{RECIPE}`.",
        f"- Kept: {kept}.",
        *(f"- {said}." for said in (progress.check or {}).get("said", [])),
        "",
        f"Held out: {task.measured}.",
        "",
        "| setting | start | these weights |",
        "| --- | --- | --- |",
        *(f"| {name} | {before} | {after} |" for name, before, after in score_table(trainer)),
        "",
        *check_table(progress.check),
    ]
    trainer.folder.write(CARD, "\n".join(lines))


def score_table(trainer: Trainer) -> list[tuple[str, str, str]]:
    """(setting, its scores at the start, at the best epoch), as text."""
    scores, shown = trainer.progress.scores, trainer.task.shown
    start, best = scores["0"], scores[str(trainer.progress.best)]
    return [(name, shown(start[name]), shown(best[name])) for name in start]


def check_table(check: dict[str, Any] | None) -> list[str]:
    """Lines of the card: the held-out pairs through ``align``, before and after."""
    if not check or not check["rows"]:
        return []
    lines = [
        "Held-out pairs through `fmr align`, before and after.",
        "",
        "| pairs of | overlap | pairs | right | aligned | wrong, yet aligned | right matches | median error, deg |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    return [*lines, *("| " + " | ".join(cells) + " |" for cells in check_cells(check)), ""]


def check_cells(check: dict[str, Any]) -> list[tuple[str, ...]]:
    """A row of that table for each kind of pairs and overlap."""

    def both(row: dict[str, Any], name: str, shape: str = "") -> str:
        values = (row[when][name] for when in ("before", "after"))
        return " to ".join("-" if value is None else format(value, shape) for value in values)

    return [
        (row["kind"], row["overlap"] or "all", str(row["pairs"]), both(row, "right"), both(row, "aligned"),
         both(row, "wrong"), both(row, "matches", ".2f"), both(row, "degrees", ".2f"))
        for row in check["rows"]
    ]  # fmt: skip
