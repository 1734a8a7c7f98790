"""A training run from files to a folder: material in, weights, card, recipe and metrics out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import fmr_cli
from fmr_cli.errors import FmrError
from fmr_cli.io.folders import find_scans
from fmr_cli.registration.models import Device, pick_device
from fmr_cli.synthetic.batches import Augment
from fmr_cli.synthetic.shapes import shapes
from fmr_cli.training.loop import (
    CARD,
    MODEL,
    RECIPE,
    STATE,
    Data,
    Trainer,
    TrainingError,
    join_processes,
    read_start,
    saved_recipe,
    success_table,
)
from fmr_cli.training.recipe import Recipe, read_recipe
from fmr_cli.training.scans import load_material, load_pairs, scene_crops

LEAST_HELD_OUT = 8  # clouds


UNBOUNDED = 10**9  # steps, where only the minutes count


def settings(
    path: Path | None,
    *,
    unsupervised: bool,
    semi_supervised: bool,
    resume: bool,
    minutes: float | None,
    epochs: int | None,
    **changes: Any,
) -> Recipe:
    """The recipe of the file, or the defaults, with the changes made (None: no change). Raises FmrError."""
    if resume:
        return Recipe()  # the run's own takes its place
    if unsupervised and semi_supervised:
        raise FmrError("--unsupervised has no use for poses; leave it away, or --semi-supervised and --pairs")
    if path is None and not (unsupervised or semi_supervised):
        raise FmrError("say how to learn: --unsupervised, --semi-supervised, or a --recipe")
    recipe = Recipe() if path is None else read_recipe(path)
    if unsupervised:
        changes["pose_weight"] = 0.0
        changes |= {"chamfer_weight": recipe.chamfer_weight or 1.0, "chamfer_until": 1.0}
    if semi_supervised:
        changes["pose_weight"] = recipe.pose_weight or 1.0
    if epochs is not None:
        changes["steps"] = epochs * recipe.epoch_steps
    elif minutes is not None:
        changes["steps"] = UNBOUNDED
    return recipe.changed(**changes)


def prepare(
    scans: list[Path],
    recipe: Recipe,
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
    if resume:
        recipe = saved_recipe(out)
    elif (out / STATE).exists():
        raise TrainingError(f"{out}: holds a run already; give another --out, or --resume to go on with it")
    place = join_processes(pick_device(device))
    start = read_start(recipe.start)
    data, warnings = read_data(scans, recipe, pairs, place, progress)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"{out}: cannot make this folder ({error.strerror}); give another --out") from None
    trainer = Trainer(recipe, data, out, start, minutes, resume)
    if trainer.rank == 0 and not resume:
        trainer.write(RECIPE, lambda path: path.write_text(recipe.toml()))
    return trainer, warnings


def read_data(
    scans: list[Path], recipe: Recipe, pairs: Path | None, device: torch.device, progress: Callable[[int, int], None]
) -> tuple[Data, list[str]]:
    """Scans and shapes as clouds on the device, a share of them held out: whole scans, where there is more than one."""
    warnings: list[str] = []
    train, held_out, described = [], [], []
    rng = np.random.default_rng(recipe.seed)
    if recipe.shapes:
        clouds = shapes(recipe.shapes, recipe.cloud_points, recipe.seed)
        count = held_out_count(len(clouds), recipe)
        train.append(clouds[count:])
        held_out.append(clouds[:count])
        described.append(f"{len(clouds) - count} procedural shapes, {count} held out")
    if recipe.scenes:
        cut = scene_crops(recipe.scenes, recipe.cloud_points, recipe.seed, progress)
        count = held_out_count(recipe.scenes, recipe)
        train += cut[count:]
        held_out += cut[:count]
        crops = sum(map(len, cut[count:]))
        described.append(f"{crops} crops of {len(cut) - count} scans of procedural scenes, {count} scans held out")
    if scans:
        material = load_material(find_scans(scans), recipe.crops, recipe.cloud_points, recipe.seed, progress)
        warnings += material.skipped
        used = np.unique(material.scan)
        unit = material.scan if len(used) > 1 else np.arange(len(material.clouds))  # of one scan, crops are held out
        if len(used) == 1:
            warnings.append("one scan alone: the held-out crops are from the scan that is trained on")
        order = rng.permutation(np.unique(unit))
        out = np.isin(unit, order[: max(round(recipe.held_out * len(order)), 1)])
        if out.all():
            raise FmrError(f"{material.files[0]}: one crop is too little to train on; give more or larger scans")
        train.append(material.clouds[~out])
        held_out.append(material.clouds[out])
        described.append(
            f"{len(material.clouds)} crops of {len(used)} scans "
            f"({', '.join(map(str, scans))}), {int(out.sum())} crops held out"
        )
    if not train:
        raise FmrError(
            "nothing to train on; give scans or folders of scans (also to --resume), or a recipe with shapes"
        )
    labelled = None
    if pairs is not None:
        a, b = load_pairs(pairs, recipe.cloud_points, recipe.seed)
        labelled = (torch.from_numpy(a).to(device), torch.from_numpy(b).to(device))
        described.append(f"{len(a)} labelled pairs ({pairs})")
    pool, test = (torch.from_numpy(np.concatenate(x)).to(device) for x in (train, held_out))
    return Data(pool, test, labelled, described), warnings


def held_out_count(clouds: int, recipe: Recipe) -> int:
    """How many procedural shapes or scenes are held out. Raises FmrError where too few are left on either side."""
    count = max(round(recipe.held_out * clouds), LEAST_HELD_OUT)
    if count >= clouds:
        raise TrainingError(f"{clouds} shapes or scenes are too few to hold {count} out; give a larger number")
    return count


def write_card(trainer: Trainer) -> None:
    """What the weights in the folder were made from, how, and how well they register."""
    recipe, progress, augment = trainer.recipe, trainer.progress, trainer.recipe.augment
    losses = [
        *([f"{recipe.anchor_steps} steps of distances to anchors"] if recipe.anchor_steps else []),
        *(["Chamfer distance through the decoder"] if recipe.chamfer_weight else []),
        *([f"point error through {recipe.unroll} unrolled IC iterations"] if recipe.pose_weight else []),
    ]
    rows = [f"| {name} | {a[0]:.2f} ({a[1]:.2f}) | {b[0]:.2f} ({b[1]:.2f}) |" for name, a, b in success_table(trainer)]
    better = progress.best > 0
    lines = [
        f"# {trainer.out.name}",
        "",
        f"Encoder weights for `fmr align --model {trainer.out / MODEL}`, written by fmr {fmr_cli.__version__}.",
        "",
        f"- Encoder: 3-{'-'.join(map(str, trainer.encoder.hidden))}-{trainer.encoder.feature_dim}, "
        f"started from {recipe.start}.",
        f"- Data: {'; '.join(trainer.data.described)}.",
        f"- Losses: {'; '.join(losses)}.",
        *([f"- Pairs: {augment_text(augment)}."] if recipe.pose_weight else []),
        f"- Steps: {progress.step} of {progress.steps}, {progress.seconds / 60:.1f} minutes on {trainer.device.type}"
        f"{f', {trainer.world} processes' if trainer.world > 1 else ''}. All settings: `{RECIPE}`.",
        f"- Kept: epoch {progress.best} of {progress.epoch - 1}."
        if better
        else "- Kept: the start. Training made the held-out registrations no better.",
        "",
        f"Share of {recipe.held_out_pairs} held-out registrations below 5 deg, and their median error in deg, from the "
        "identity, 10 iterations, robust steps, 512 points, source and target sampled apart:",
        "",
        "| setting | start | these weights |",
        "| --- | --- | --- |",
        *rows,
        "",
    ]
    trainer.write(CARD, lambda path: path.write_text("\n".join(lines)))


def augment_text(augment: Augment) -> str:
    return (
        f"rotation up to {augment.rotation:g} deg, shift up to {augment.shift:g}, noise up to {augment.noise:g}, "
        f"overlap down to {augment.overlap:.0%}, density down to {augment.density:.0%}"
    )
