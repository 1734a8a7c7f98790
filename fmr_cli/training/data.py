"""The clouds that the global encoder learns from: procedural shapes, crops of procedural scenes, crops of scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from fmr_cli.errors import FmrError
from fmr_cli.io.folders import find_scans
from fmr_cli.synthetic.shapes import shapes
from fmr_cli.training.global_task import Data
from fmr_cli.training.recipe import Recipe
from fmr_cli.training.run_folder import TrainingError
from fmr_cli.training.scans import load_material, load_pairs, scene_crops

LEAST_HELD_OUT = 8  # clouds: with fewer, the settings of a test would register the same few again and again

Progress = Callable[[int, int], None]


class Pool:
    """Clouds (n, M, 3) to train on and to hold out, as they are gathered, with a description and warnings of each."""

    def __init__(self) -> None:
        self.train: list[np.ndarray] = []
        self.held_out: list[np.ndarray] = []
        self.described: list[str] = []
        self.warnings: list[str] = []

    def add_shapes(self, recipe: Recipe) -> None:
        """The recipe's procedural shapes."""
        clouds = shapes(recipe.shapes, recipe.cloud_points, recipe.seed)
        count = held_out_count(len(clouds), recipe)
        self.train.append(clouds[count:])
        self.held_out.append(clouds[:count])
        self.described.append(f"{len(clouds) - count} procedural shapes, {count} held out")

    def add_scenes(self, recipe: Recipe, progress: Progress) -> None:
        """Crops of the recipe's procedural scenes; whole scans are held out."""
        cut = scene_crops(recipe.scenes, recipe.cloud_points, recipe.seed, progress)
        count = held_out_count(recipe.scenes, recipe)
        self.train += cut[count:]
        self.held_out += cut[:count]
        crops = sum(map(len, cut[count:]))
        self.described.append(f"{crops} crops of {len(cut) - count} scans of procedural scenes, {count} scans held out")

    def add_scans(self, scans: list[Path], recipe: Recipe, progress: Progress) -> None:
        """Crops of the user's scans; whole scans are held out, where there is more than one. Raises FmrError."""
        rng = np.random.default_rng(recipe.seed)
        material = load_material(find_scans(scans), recipe.crops, recipe.cloud_points, recipe.seed, progress)
        self.warnings += material.skipped
        used = np.unique(material.scan)
        unit = material.scan if len(used) > 1 else np.arange(len(material.clouds))  # of one scan, crops are held out
        if len(used) == 1:
            self.warnings.append("one scan alone: the held-out crops are from the scan that is trained on")
        order = rng.permutation(np.unique(unit))
        out = np.isin(unit, order[: max(round(recipe.held_out * len(order)), 1)])
        if out.all():
            raise FmrError(f"{material.files[0]}: one crop is too little to train on; give more or larger scans")
        self.train.append(material.clouds[~out])
        self.held_out.append(material.clouds[out])
        names = ", ".join(map(str, scans))
        self.described.append(
            f"{len(material.clouds)} crops of {len(used)} scans ({names}), {int(out.sum())} crops held out"
        )


def read_data(
    scans: list[Path], recipe: Recipe, pairs: Path | None, device: torch.device, progress: Progress
) -> tuple[Data, list[str]]:
    """All that the recipe and the command line name, as clouds on the device; and warnings. Raises FmrError."""
    pool = Pool()
    if recipe.shapes:
        pool.add_shapes(recipe)
    if recipe.scenes:
        pool.add_scenes(recipe, progress)
    if scans:
        pool.add_scans(scans, recipe, progress)
    if not pool.train:
        raise FmrError(
            "nothing to train on; give scans or folders of scans (also to --resume), or a recipe with shapes"
        )
    labelled = None
    if pairs is not None:
        a, b = load_pairs(pairs, recipe.cloud_points, recipe.seed)
        labelled = (torch.from_numpy(a).to(device), torch.from_numpy(b).to(device))
        pool.described.append(f"{len(a)} labelled pairs ({pairs})")
    train, held_out = (torch.from_numpy(np.concatenate(x)).to(device) for x in (pool.train, pool.held_out))
    return Data(train, held_out, labelled, pool.described), pool.warnings


def held_out_count(clouds: int, recipe: Recipe) -> int:
    """How many procedural shapes or scenes are held out. Raises TrainingError: too few are left on either side."""
    count = max(round(recipe.held_out * clouds), LEAST_HELD_OUT)
    if count >= clouds:
        raise TrainingError(f"{clouds} shapes or scenes are too few to hold {count} out; give a larger number")
    return count
