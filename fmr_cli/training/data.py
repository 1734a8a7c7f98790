"""Batches of training pairs, drawn from a pool of normalised clouds on the device that trains."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fmr_cli.feature_metric import se3


@dataclass
class Augment:
    """How source and target of a pair differ. Ranges are (from, to), drawn evenly for each pair."""

    rotation: float = 45.0  # degrees, about any axis
    shift: float = 0.1  # of the cloud's size, on top of what each cloud's own centring leaves
    noise: float = 0.02  # largest standard deviation, units of the normalised cloud
    overlap: float = 0.6  # least share of each cloud that the other has too; 1 for whole clouds
    whole: float = 0.3  # share of the pairs that overlap fully
    density: float = 0.1  # least share of the points that the source keeps


def random_rotations(count: int, generator: torch.Generator, device: torch.device | str) -> Tensor:
    """(count, 3, 3), uniform in SO(3)."""
    q = torch.randn(count, 4, generator=generator, device=device)
    return se3.from_quaternion(q / q.norm(dim=-1, keepdim=True))


def random_motion(count: int, degrees: float, shift: float, generator: torch.Generator, device: torch.device | str) -> Tensor:
    """(count, 4, 4): a rotation of up to ``degrees`` about any axis and a shift of up to ``shift`` in any direction."""
    directions = torch.randn(2, count, 3, generator=generator, device=device)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    sizes = torch.rand(2, count, 1, generator=generator, device=device)
    T = torch.eye(4, device=device).repeat(count, 1, 1)
    twist = torch.cat([directions[0] * sizes[0] * degrees * torch.pi / 180, torch.zeros(count, 3, device=device)], -1)
    T[:, :3, :3] = se3.exp(twist)[:, :3, :3]
    T[:, :3, 3] = directions[1] * sizes[1] * shift
    return T


def draw_clouds(pool: Tensor, batch: int, generator: torch.Generator) -> Tensor:
    """(batch, M, 3) clouds of the pool (S, M, 3), each turned uniformly in SO(3) and of half extent 0.5 again."""
    index = torch.randint(len(pool), (batch,), generator=generator, device=pool.device)
    clouds = pool[index] @ random_rotations(batch, generator, pool.device)
    return clouds * (0.5 / clouds.abs().amax((1, 2), keepdim=True))


def subset(clouds: Tensor, points: int, generator: torch.Generator) -> Tensor:
    """(B, points, 3): as many random points of every cloud (B, M, 3), without repeats where there are enough."""
    M = clouds.shape[1]
    order = torch.rand(M, generator=generator, device=clouds.device).argsort()
    return clouds[:, order.repeat(-(-points // M))[:points]]


def draw_pairs(
    pool: Tensor, batch: int, points: int, augment: Augment, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """source, target (batch, points or fewer, 3) and T_target_source (batch, 4, 4).

    Two disjoint samples of a cloud, each cut by the same random direction so that only a share is common; the clouds
    are normalised as at inference: each centred on its own mean, both by one scale.
    """
    device = pool.device
    clouds = draw_clouds(pool, batch, generator)
    M = clouds.shape[1]
    clouds = clouds[:, torch.rand(M, generator=generator, device=device).argsort()]
    direction = torch.randn(batch, 3, 1, generator=generator, device=device)
    halves = []
    overlap = 1 - (1 - augment.overlap) * torch.rand(batch, generator=generator, device=device)
    overlap = torch.where(torch.rand(batch, generator=generator, device=device) < augment.whole, 1.0, overlap)
    keep = 1 / (2 - overlap)  # two parts of this share of the cloud have `overlap` of each in common
    for side, half in ((1, clouds[:, ::2]), (-1, clouds[:, 1::2])):
        order = (side * (half @ direction)[..., 0]).argsort(1)
        rank = torch.rand(batch, half.shape[1], generator=generator, device=device).argsort(1)[:, :points]
        # ranks within the kept part: the first keep * M/2 of the sorted ones, spread evenly
        chosen = (rank * keep[:, None]).long()
        halves.append(half.gather(1, order.gather(1, chosen)[..., None].expand(-1, -1, 3)))
    source, target = halves
    low = torch.rand((), generator=generator, device=device)
    kept = int(points * float(augment.density ** (low * low)))  # mostly dense, now and then a tenth
    source = source[:, : max(kept, 32)]
    sigma = augment.noise * torch.rand(batch, 1, 1, generator=generator, device=device).square()
    source = source + sigma * torch.randn(source.shape, generator=generator, device=device)
    target = target + sigma * torch.randn(target.shape, generator=generator, device=device)

    motion = random_motion(batch, augment.rotation, augment.shift, generator, device)
    moved = se3.transform(torch.linalg.inv(motion), source)  # motion maps what the solver gets back onto the target
    centre_s, centre_t = moved.mean(1), target.mean(1)
    scale = 0.5 / torch.maximum((moved - centre_s[:, None]).abs().amax((1, 2)), (target - centre_t[:, None]).abs().amax((1, 2)))
    truth = motion.clone()
    # centred source s' = s - cs moves to R (s' + cs) + t - ct
    offset = (motion[:, :3, :3] @ centre_s[..., None])[..., 0] + motion[:, :3, 3] - centre_t
    spread = augment.shift * 0
    truth[:, :3, 3] = (offset + spread) * scale[:, None]
    return (moved - centre_s[:, None]) * scale[:, None, None], (target - centre_t[:, None]) * scale[:, None, None], truth
