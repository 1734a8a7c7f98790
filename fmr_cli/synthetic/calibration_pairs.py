"""What the verdict is calibrated on: ``verdict_pairs`` of every kind, many of them bent as real scans are.

A scan that was fused from many frames has drifted, and a depth camera warps what it sees, over a few centimetres as
over metres. So most pairs are bent, each cloud by waves of its own, long and short.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmr_cli.synthetic.draft import log_uniform
from fmr_cli.synthetic.verdict_pairs import FAMILIES, KINDS, VerdictPair, make_pair

UNTOUCHED = 0.25  # of the others stay as they are
WAVES = 12
LENGTHS = 0.03, 2.5  # of a wave, shares of a scan's size; its amplitude grows with their square root
BENDS = 10**-3.0, 10**-1.75  # amplitudes of a wave of the size, shares of it: 1 to 18 mm a metre, as hand-held cameras
# What may not be bent: there, a bend would decide what the pair is about.
UNBENT = {
    *FAMILIES["degenerate"],
    *FAMILIES["strays"],
    "scaled object",
    "scaled room",
    "mirrored room",
    "mirrored object",
}
# The common cases come again: users have more of them than of riddles.
DRAWN = (*KINDS, *FAMILIES["ordinary"], *3 * tuple(FAMILIES["shy"]))


def calibration_pair(seed: int, number: int) -> VerdictPair:
    """Pair ``number`` of a run: the kinds take turns."""
    rng = np.random.default_rng((seed, number))
    pair = make_pair(DRAWN[number % len(DRAWN)], rng)
    if pair.kind in UNBENT or rng.random() < UNTOUCHED:
        return pair
    return bent_pair(pair, rng)


def bent_pair(pair: VerdictPair, rng: np.random.Generator) -> VerdictPair:
    """The pair with both clouds bent, each by waves of its own, as strongly as real scans are."""
    amplitude = log_uniform(rng, *BENDS)
    source, target = (bent(points, amplitude, rng) for points in (pair.source, pair.target))
    return replace(pair, source=source, target=target)


def bent(points: np.ndarray, amplitude: float, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) moved by waves of many lengths; amplitude: of one as long as their size, a share of it."""
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    size, middle, out = float((high - low).max()), points.mean(0), points.copy()
    for _ in range(WAVES):
        wave, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        length = log_uniform(rng, *LENGTHS)
        phase = (points - middle) @ (wave * 2 * np.pi / (length * size)) + rng.uniform(0, 2 * np.pi)
        out += np.outer(np.sin(phase), shift * amplitude * size * np.sqrt(length) * rng.uniform(0.3, 1))
    return out
