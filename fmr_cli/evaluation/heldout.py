"""Registration of clouds with a known transform at fixed settings: how encoders are compared and chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.solver import make_template, solve
from fmr_cli.geometry import se3
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.synthetic.batches import Pairs, cut, draw_clouds, make_pairs, random_motions

SUCCESS = 5.0  # degrees: a registration that is less off counts, as in the paper's basin of convergence


@dataclass(frozen=True)
class Setting:
    """One way in which source and target differ. Angles in degrees, lengths in units of the normalised cloud."""

    name: str
    rotation: tuple[float, float]  # from, to
    shift: float = 0.0  # at most
    resample: bool = True  # source and target are different samples of the surface
    noise: float = 0.0  # standard deviation
    density: float = 1.0  # share of the points that the source keeps
    overlap: float = 1.0  # share of each cloud that the other one has too


HARD = (
    Setting("resampled", (40, 80)),
    Setting("noise", (40, 80), noise=0.01),
    Setting("density 10 %", (40, 80), density=0.1),
    Setting("overlap 90 %", (40, 40), overlap=0.9),
    Setting("overlap 80 %", (40, 40), overlap=0.8),
    Setting("overlap 70 %", (40, 40), overlap=0.7),
)


def draw(pool: Tensor, setting: Setting, count: int, points: int, seed: int) -> Pairs:
    """``count`` pairs of the clouds (S, M, 3) at a setting, the same for the same seed. Both clouds are centred."""
    generator = torch.Generator(pool.device).manual_seed(seed)
    clouds = draw_clouds(pool, count, generator)
    a, b = (clouds[:, ::2], clouds[:, 1::2]) if setting.resample else (clouds, clouds)
    if setting.overlap < 1:
        a, b = cut(a, b, torch.full((count,), setting.overlap, device=pool.device), points, generator)
    a, b = a[:, :points], b[:, :points]
    a = a[:, : max(int(setting.density * a.shape[1]), 3)]
    low, high = setting.rotation
    one = torch.ones(count, device=pool.device)
    spread = torch.rand(count, generator=generator, device=pool.device)
    shift = setting.shift * torch.rand(count, generator=generator, device=pool.device)
    truth = random_motions(low + (high - low) * spread, shift, generator)
    return make_pairs(a, b, truth, setting.noise * one, True, 0 * one, generator)


@torch.inference_mode()
def register(encoder: Encoder, pairs: Pairs, iterations: int = 10, robust: bool = True, batch: int = 32) -> Tensor:
    """(B, 4, 4) float64 estimates of T_target_source from the identity, by the IC solver alone."""
    found = []
    for first in range(0, len(pairs), batch):
        part = pairs[first : first + batch]
        start = torch.eye(4, device=part.source.device).repeat(len(part), 1, 1)
        g = solve(encoder, make_template(encoder, part.target), part.source, start, iterations, robust).g
        found.append(g.double())
    return torch.cat(found)


@dataclass
class Errors:
    """Of B estimates: rotation (B,) in degrees, translation (B,), rmse (B,) of the twist of the difference."""

    rotation: np.ndarray
    translation: np.ndarray
    rmse: np.ndarray

    @property
    def success(self) -> float:
        """Share of the rotations below 5 degrees."""
        return float((self.rotation < SUCCESS).mean())

    @property
    def median(self) -> float:
        """Of the rotation errors, in degrees."""
        return float(np.median(self.rotation))


def errors(estimate: Tensor, truth: Tensor) -> Errors:
    """Estimates against truths, both (B, 4, 4). NaN counts as half a turn."""
    found, true = (x.double().cpu().numpy() for x in (estimate, truth))
    rotation, translation = pose_error(found, true)
    twist = np.nan_to_num(se3.log(np.linalg.inv(true) @ found), nan=np.pi)
    return Errors(np.nan_to_num(rotation, nan=180.0), translation, np.sqrt((twist**2).mean(-1)))


def score(
    encoder: Encoder,
    pool: Tensor,
    settings: tuple[Setting, ...],
    count: int,
    points: int,
    *,
    robust: bool = True,
    first_seed: int = 0,
) -> dict[str, Errors]:
    """The errors of an encoder on held-out clouds (S, M, 3) at every setting."""
    found = {}
    for seed, setting in enumerate(settings, first_seed):
        pairs = draw(pool, setting, count, points, seed)
        found[setting.name] = errors(register(encoder, pairs, robust=robust), pairs.truth)
    return found
