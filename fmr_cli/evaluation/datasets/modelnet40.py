"""ModelNet40: CAD models in 40 categories, CATEGORY/test/*.off (Wu et al. 2015).

The first 20 categories are those that the paper (Huang et al. 2020) trains on, the other 20 are unseen by it; this
project's weights have seen none. Each model gives two pairs: ``whole``, the paper's, the same 1,024 points turned by up
to 60 deg and shifted by up to 0.8; and ``partial``, RPM-Net's (Yew and Lee 2020): two samples, each cut to 0.7 by a
plane of its own, with noise, turned by up to 45 deg and shifted by up to 0.5. Lengths are in units of the model, scaled
into the unit sphere. Right is less than 5 deg and 0.1.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.errors import FmrError
from fmr_cli.evaluation.datasets.pair import DataSet, Loaded, Pair, Within
from fmr_cli.io import read_cloud

SEEN = (
    "airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair", "cone", "cup", "curtain",
    "desk", "door", "dresser", "flower_pot", "glass_box", "guitar", "keyboard", "lamp",
)  # fmt: skip
UNSEEN = (
    "laptop", "mantel", "monitor", "night_stand", "person", "piano", "plant", "radio", "range_hood", "sink", "sofa",
    "stairs", "stool", "table", "tent", "toilet", "tv_stand", "vase", "wardrobe", "xbox",
)  # fmt: skip
POINTS = 1024
ROTATION, TRANSLATION = 60.0, 0.8  # whole: degrees, of the unit sphere
PARTIAL_ROTATION, PARTIAL_TRANSLATION = 45.0, 0.5
KEPT = 0.7  # of the points
NOISE, CLIP = 0.01, 0.05
DEGREES, SHIFT = 5.0, 0.1


def recognise(paths: Sequence[Path]) -> bool:
    return any(files(path, category) for path in paths for category in (*SEEN, *UNSEEN))


def files(path: Path, category: str) -> list[Path]:
    return sorted((path / category / "test").glob("*.off"))


def read(paths: Sequence[Path], *, seed: int = 0) -> DataSet:
    """seed: of samples, motions, cuts and noise; each model draws its own. Raises FmrError."""
    pairs = [
        Pair(f"{group}, {kind}", file.stem, kind, loader(file, kind, seed))
        for kind in ("whole", "partial")
        for group, categories in (("seen", SEEN), ("unseen", UNSEEN))
        for category in categories
        for path in paths
        for file in files(path, category)
    ]
    if not pairs:
        raise FmrError(f"{', '.join(map(str, paths))}: no CATEGORY/test/*.off in there, as ModelNet40 has them")
    return DataSet("ModelNet40", pairs, Within(DEGREES, SHIFT))


def loader(file: Path, kind: str, seed: int) -> Callable[[], Loaded]:
    def load() -> Loaded:
        rng = np.random.default_rng((seed, zlib.crc32(f"{file.stem} {kind}".encode())))
        surface = read_cloud(file, mesh_points=2 * POINTS, seed=seed).points
        surface = surface - surface.mean(0)
        surface = rng.permutation(surface / np.linalg.norm(surface, axis=1).max())
        if kind == "whole":
            T = motion(rng, ROTATION, TRANSLATION)
            source = surface[:POINTS]
            return Loaded(source, transform_points(T, source), T)
        T = motion(rng, PARTIAL_ROTATION, PARTIAL_TRANSLATION)
        source, target = (noisy(cut(part, rng), rng) for part in (surface[:POINTS], surface[POINTS:]))
        return Loaded(source, transform_points(T, target), T)

    return load


def motion(rng: np.random.Generator, degrees: float, shift: float) -> np.ndarray:
    """A rotation by up to ``degrees`` about any axis, a shift by up to ``shift`` in any direction: (4, 4)."""
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(axis * np.radians(rng.uniform(0, degrees))).as_matrix()
    T[:3, 3] = direction * rng.uniform(0, shift)
    return T


def cut(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The share KEPT of points (N, 3) that lies furthest in a random direction."""
    along = points @ rng.normal(size=3)
    return points[along >= np.quantile(along, 1 - KEPT)]


def noisy(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return points + np.clip(rng.normal(0, NOISE, points.shape), -CLIP, CLIP)
