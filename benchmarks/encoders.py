"""Encoders on held-out procedural clouds, by the IC solver from the identity: the tables of models/README.md.

    python -m benchmarks.encoders models/base.safetensors runs/mine/model.safetensors

Shares below 5 deg of 10 iterations on 512 points. Robust: resampled, noisy, thinned out (40 to 80 deg), cut (40 deg);
plain: the same points, 60 and 80 deg off. Shapes are of the training kind, others are never trained on, rooms are crops
of procedural scans; none is in a training run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import show
from fmr_cli.evaluation.heldout import HARD, Setting, score
from fmr_cli.registration.models import load_encoder
from fmr_cli.synthetic import scenes, shapes
from fmr_cli.training.scans import crops_of

POINTS, CLOUD_POINTS = 512, 2048  # of a pair's clouds, and of those that they are drawn from: as in training
SEED = 777_777  # of the shapes; no recipe has it
PLAIN = tuple(Setting(f"plain {angle} deg", (angle, angle), 0.8, resample=False) for angle in (60, 80))


def rooms(count: int) -> np.ndarray:
    """One crop each (count, CLOUD_POINTS, 3), at most, of scans of fresh procedural rooms."""
    found: list[np.ndarray] = []
    number = 0
    while len(found) < count:
        rng = np.random.default_rng((987_654, number))
        number += 1
        eye = np.array([*rng.normal(0, 0.7, 2), rng.uniform(1, 1.8)])
        scan = scenes.room_scan(scenes.room(rng), rng, eye, rng.uniform(0, 2 * np.pi), int(rng.integers(3, 8)))
        found += crops_of(scan, 1, CLOUD_POINTS, rng)
    return np.stack(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--pairs", type=int, default=40, help="of each setting")
    args = parser.parse_args()
    torch.set_num_threads(1)
    made = {"shapes": shapes.shapes(96, CLOUD_POINTS, SEED), "others": shapes.others(96, CLOUD_POINTS, SEED)}
    pools = {name: torch.from_numpy(clouds) for name, clouds in {**made, "rooms": rooms(48)}.items()}
    rows = []
    for model in args.models:
        encoder = load_encoder(model)
        for clouds, pool in pools.items():
            robust = {name: e.success for name, e in score(encoder, pool, HARD, args.pairs, POINTS).items()}
            plain = score(encoder, pool, PLAIN, args.pairs, POINTS, first_seed=50, robust=False)
            row = {"encoder": model.name, "clouds": clouds, **robust, "mean": float(np.mean(list(robust.values())))}
            rows.append(row | {name: f"{e.success:.2f} ({e.rmse.mean():.3f})" for name, e in plain.items()})
    show("below 5 deg (mean RMSE of the transform)", rows)


if __name__ == "__main__":
    main()
