"""Train the local patch encoder: InfoNCE between two scans' views of one place, on procedural scenes alone, no labels.

The scenes know where both scanners stood, so every keypoint of one scan has its place in the other for free.
"""

from __future__ import annotations

import itertools
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from fmr_cli.cores import usable_cores
from fmr_cli.descriptors.patch_encoder import CHANNELS, NEIGHBOURS, PATCH_RADIUS, describe_patches
from fmr_cli.geometry.sampling import working_scale
from fmr_cli.geometry.surface import Surface
from fmr_cli.synthetic.pairs import degrade, scan_pair

TEMPERATURE = 0.07
PER_PAIR = 128  # correspondences taken from a pair of scans
LEAST = 500  # points of a scan, of which a crop may leave none
APART = 3.0  # voxel edges: nearer places are not each other's negatives


class LocalNet(nn.Module):
    """``patch_encoder.LocalEncoder`` as it is trained: (K, PATCH_POINTS, CHANNELS) -> (K, 32), unit length."""

    def __init__(self, point: tuple[int, ...] = (64, 128, 128), head: tuple[int, ...] = (128, 32)) -> None:
        super().__init__()
        self.point = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise((CHANNELS, *point)))
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise((point[-1], *head)))

    def forward(self, patches: Tensor) -> Tensor:
        x = patches
        for layer in self.point:
            x = torch.relu(layer(x))
        x = x.amax(-2)
        for layer in self.head[:-1]:
            x = torch.relu(layer(x))
        return nn.functional.normalize(self.head[-1](x), dim=-1)


@dataclass
class Views:
    """Corresponding patches of two scans: (n, PATCH_POINTS, CHANNELS) each, and their places (n, 3) in voxels."""

    source: Tensor
    target: Tensor
    place: Tensor


def make_views(rng: np.random.Generator, count: int) -> Views | None:
    """Up to ``count`` corresponding patches of a fresh pair, or None where the two scans hardly share a surface."""
    pair: list[np.ndarray] = list(scan_pair(rng))
    if min(map(len, pair)) >= LEAST:
        pair = [degrade(p, rng) for p in pair]
    if min(map(len, pair)) < LEAST:
        return None
    scales = [working_scale(p, rng) for p in pair]
    edge = max(max(v for v, _ in scales), max(s for _, s in scales)) * rng.uniform(0.8, 1.25)
    turned = [Rotation.random(random_state=rng) for _ in pair]
    source, target = (Surface(t.apply(p), edge) for t, p in zip(turned, pair, strict=True))
    where = turned[0].apply(source.points, inverse=True)
    distance, match = cKDTree(turned[1].apply(target.points, inverse=True)).query(where)
    index = source.keypoints(2 * count)
    index = index[distance[index] < 0.75 * edge]
    if len(index) < 16:
        return None
    index = rng.permutation(index)[:count]
    a, b = (
        torch.from_numpy(describe_patches(**s.patches(i, PATCH_RADIUS, NEIGHBOURS)))
        for s, i in ((source, index), (target, match[index]))
    )
    return Views(a, b, torch.from_numpy(where[index] / edge).float())


def info_nce(a: Tensor, b: Tensor, place: Tensor) -> Tensor:
    """InfoNCE of descriptors a, b (n, d) whose rows correspond; rows of places within APART do not repel."""
    logits = a @ b.T / TEMPERATURE
    close = (torch.cdist(place, place) < APART) & ~torch.eye(len(a), dtype=torch.bool)
    logits = logits.masked_fill(close, -1e4)
    label = torch.arange(len(a))
    return (torch.nn.functional.cross_entropy(logits, label) + torch.nn.functional.cross_entropy(logits.T, label)) / 2


def pair_views(seed: tuple[int, int]) -> Views:
    """The views of pair ``seed`` = (run, number): the first pair of its own random stream that shares a surface."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    while True:
        views = make_views(rng, PER_PAIR)
        if views is not None:
            return views


def make_material(pairs: int, seed: int, workers: int) -> list[Views]:
    """``pairs`` scan pairs, the same whatever the number of worker processes."""
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(pair_views, [(seed, i) for i in range(pairs)], chunksize=4))


def train(material: list[Views], steps: int, seed: int, batch: int = 4) -> LocalNet:
    """Train for ``steps`` steps of ``batch`` pairs each (Adam 1e-3, cosine, bfloat16 products); logs to stderr."""
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    start = time.time()
    held_out, material = material[: len(material) // 20], material[len(material) // 20 :]
    model = LocalNet()
    optimiser = torch.optim.Adam(model.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for step in range(1, steps + 1):
        chosen = [material[i] for i in rng.choice(len(material), batch, replace=False)]
        with torch.autocast("cpu", torch.bfloat16):
            described = model(torch.cat([x for v in chosen for x in (v.source, v.target)])).float()
        parts = iter(described.split([len(v.place) for v in chosen for _ in range(2)]))
        loss = torch.stack([info_nce(next(parts), next(parts), v.place) for v in chosen]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 200 == 0 or step == steps:
            rank1 = np.mean([held_out_rank1(model, v) for v in held_out])
            said = f"step {step}, loss {loss.item():.3f}, held-out rank-1 {rank1:.3f}, {time.time() - start:.0f} s"
            print(said, file=sys.stderr, flush=True)
    return model


@torch.no_grad()
def held_out_rank1(model: LocalNet, views: Views) -> float:
    """How often the nearest descriptor among the other scan's is of the same place (within APART)."""
    best = (model(views.source) @ model(views.target).T).argmax(1)
    return float(((views.place[best] - views.place).norm(dim=1) < APART).float().mean())


def main(out: str, pairs: int = 480, steps: int = 2400, seed: int = 0) -> None:
    """``python -m fmr_cli.training.local models/local.safetensors``: the bundled local encoder, from code alone."""
    from safetensors.torch import save_file

    material = make_material(pairs, seed, workers=usable_cores())
    torch.set_num_threads(1)
    model = train(material, steps, seed)
    save_file(model.state_dict(), out)


if __name__ == "__main__":
    main(sys.argv[1])
