"""Pairs of clouds with a known transform, in batches on the device that trains; the held-out tests draw here too."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fmr_cli.geometry import se3


@dataclass(frozen=True)
class Augment:
    """How the source and target of a training pair differ. Each is drawn anew for every pair (density: every batch)."""

    rotation: float = 45.0  # degrees at most, about any axis
    shift: float = (
        0.8  # at most, in units of the normalised cloud; centring takes it out again where nothing is cut off
    )
    centre: bool = True  # both clouds centred on their own mean, as `fmr align` does
    offset: float = 0.05  # at most; a shift that stays after centring
    noise: float = 0.02  # largest standard deviation, in units of the normalised cloud
    overlap: float = 0.6  # least share of each cloud that the other one has too; 1 for whole clouds
    whole: float = 0.3  # share of the pairs that overlap fully
    density: float = 0.1  # least share of the points that the source keeps


@dataclass
class Pairs:
    """source (B, N, 3), target (B, M, 3), normalised; truth: (B, 4, 4) T_target_source."""

    source: Tensor
    target: Tensor
    truth: Tensor

    def __getitem__(self, rows: slice) -> Pairs:
        return Pairs(self.source[rows], self.target[rows], self.truth[rows])

    def __len__(self) -> int:
        return len(self.truth)


def random_rotations(count: int, generator: torch.Generator) -> Tensor:
    """(count, 3, 3), uniform in SO(3)."""
    q = torch.randn(count, 4, generator=generator, device=generator.device)
    return se3.from_quaternion(q / q.norm(dim=-1, keepdim=True))


def random_directions(count: int, generator: torch.Generator) -> Tensor:
    """(count, 3) unit vectors, uniform on the sphere."""
    v = torch.randn(count, 3, generator=generator, device=generator.device)
    return v / v.norm(dim=-1, keepdim=True)


def random_motions(degrees: Tensor, shift: Tensor, generator: torch.Generator) -> Tensor:
    """(B, 4, 4): rotations by ``degrees`` (B,) about any axis and shifts by ``shift`` (B,) in any direction."""
    twist = random_directions(len(degrees), generator) * torch.deg2rad(degrees)[:, None]
    T = se3.exp(torch.cat([twist, torch.zeros_like(twist)], -1))
    T[:, :3, 3] = random_directions(len(degrees), generator) * shift[:, None]
    return T


def draw_clouds(pool: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count, M, 3) clouds of the pool (S, M, 3), each turned uniformly in SO(3), half extent 0.5, in random order."""
    index = torch.randint(len(pool), (count,), generator=generator, device=pool.device)
    order = torch.rand(pool.shape[1], generator=generator, device=pool.device).argsort()
    clouds = pool[index][:, order] @ random_rotations(count, generator)
    return clouds * (0.5 / clouds.abs().amax((1, 2), keepdim=True))


def draw_pairs(pool: Tensor, count: int, points: int, augment: Augment, generator: torch.Generator) -> Pairs:
    """Training pairs of clouds of the pool (S, M, 3); source and target are disjoint samples of ``points`` at most."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, device=pool.device)

    clouds = draw_clouds(pool, count, generator)
    overlap = 1 - (1 - augment.overlap) * uniform(count)
    overlap = torch.where(uniform(count) < augment.whole, 1.0, overlap)
    density = augment.density ** float(uniform().square())  # mostly dense, now and then sparse
    source, target = cut(clouds[:, ::2], clouds[:, 1::2], overlap, points, generator)
    source = source[:, : max(int(density * source.shape[1]), 32)]
    sigma = augment.noise * uniform(count).square()
    truth = random_motions(augment.rotation * uniform(count), augment.shift * uniform(count), generator)
    offset = augment.offset * uniform(count)
    return make_pairs(source, target, truth, sigma, augment.centre, offset, generator)


def cut(a: Tensor, b: Tensor, overlap: Tensor, points: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Both (B, N, 3) cut by one random direction, so that a share ``overlap`` (B,) is common; ``points`` of each.

    Two ends that each hold 1 / (2 - overlap) of a cloud have that share of themselves in common.
    """
    direction = random_directions(len(a), generator)[..., None]
    keep = 1 / (2 - overlap)
    parts = []
    for side, cloud in ((1, a), (-1, b)):
        order = (side * (cloud @ direction)[..., 0]).argsort(1)
        rank = torch.rand(order.shape, generator=generator, device=a.device).argsort(1)[:, :points]
        chosen = order.gather(1, (rank * keep[:, None]).long())  # spread evenly over the first `keep` of the sorted
        parts.append(cloud.gather(1, chosen[..., None].expand(-1, -1, 3)))
    return parts[0], parts[1]


def make_pairs(
    source: Tensor,
    target: Tensor,
    truth: Tensor,
    sigma: Tensor,
    centre: bool,
    offset: Tensor,
    generator: torch.Generator,
) -> Pairs:
    """Source (B, N, 3), lying on target (B, M, 3), is taken away by the inverse of truth (B, 4, 4); both normalised.

    One scale for both (largest half extent 0.5). ``centre``: each cloud is centred on its own mean, else both on the
    target's. sigma (B,): noise on every coordinate. offset (B,): a shift of the source that stays.
    """
    source, target = (
        x + sigma[:, None, None] * torch.randn(x.shape, generator=generator, device=x.device) for x in (source, target)
    )
    source = se3.transform(torch.linalg.inv(truth), source)
    cs, ct = source.mean(1), target.mean(1)
    scale = 0.5 / torch.maximum(*((x - c[:, None]).abs().amax((1, 2)) for x, c in ((source, cs), (target, ct))))
    if not centre:
        cs = ct
    stay = random_directions(len(source), generator) * offset[:, None]
    # x' = (x - cs) scale + stay, so that x_target' = R x' + (R cs + t - ct) scale - R stay
    R, t = truth[:, :3, :3], truth[:, :3, 3]
    normalised = truth.clone()
    normalised[:, :3, 3] = ((R @ cs[..., None])[..., 0] + t - ct) * scale[:, None] - (R @ stay[..., None])[..., 0]
    source = (source - cs[:, None]) * scale[:, None, None] + stay[:, None]
    return Pairs(source, (target - ct[:, None]) * scale[:, None, None], normalised)
