"""What `fmr evaluate` compares: this method with any weights, and the paper's baselines on the very same pairs.

A method takes normalised pairs and gives (B, 4, 4) float64 estimates of T_target_source, one a pair.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.resources import as_file, files

import numpy as np
import torch
from torch import Tensor

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import RegistrationError
from fmr_cli.evaluation.baselines import Baseline, filled, gicp, global_baselines_at, lm_icp
from fmr_cli.evaluation.heldout import register
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.registration.models import Device, encoder
from fmr_cli.registration.pipeline import align
from fmr_cli.synthetic.batches import Pairs

Method = Callable[[Pairs], Tensor]

VOXEL = 0.02  # of the unit box, for the baselines that work on a grid: 50 edges across a cloud, fewer of a sparse one
REACH = 0.2  # of the unit box, the farthest correspondence of GICP, which starts at the identity, up to 0.5 off


def ours(weights: Encoder, iterations: int, robust: bool) -> Method:
    """The IC solver from the identity: one start, no search, no geometric refinement."""
    return lambda pairs: register(weights, pairs, iterations, robust)


def product() -> Method:
    """`fmr align` as users run it: nothing but the two clouds, every option at its default."""

    def run(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        try:
            return align(PointCloud(source), PointCloud(target), hints=False).T_target_source
        except RegistrationError:  # too few points; half a turn off is what `errors` makes of it
            return np.full((4, 4), np.nan)

    return one_by_one(run)


def one_by_one(baseline: Baseline) -> Method:
    """A method from a function of one pair."""

    def run(pairs: Pairs) -> Tensor:
        clouds = zip(pairs.source.double().cpu().numpy(), pairs.target.double().cpu().numpy(), strict=True)
        found = np.stack([baseline(source, target) for source, target in clouds])
        return torch.from_numpy(found).to(pairs.source.device)

    return run


def pointnetlk(device: Device, iterations: int) -> Method:
    """The same IC with plain steps and an encoder trained on the pose loss alone, by models/pointnetlk.toml."""
    with as_file(files("fmr_cli.models") / "pointnetlk.safetensors") as path:
        return ours(encoder(path, device), iterations, robust=False)


def baselines(device: Device, iterations: int) -> tuple[dict[str, Method], list[str]]:
    """PointNetLK, the baselines whose libraries are installed, and a line for each that is not.

    FPFH + RANSAC stands in the place of the paper's 3DSmoothNet.
    """

    def gicp_on_grid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return gicp(source, target, filled(VOXEL, source, target), reach=REACH)

    there, missing = global_baselines_at(partial(filled, VOXEL))
    known: dict[str, Baseline] = {"LM-ICP": lm_icp, "small_gicp": gicp_on_grid, **there}
    return {"PointNetLK": pointnetlk(device, iterations), **{n: one_by_one(f) for n, f in known.items()}}, missing
