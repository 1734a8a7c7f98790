"""Calibrate the verdict: logistic regression on the evidence at right and wrong poses of procedural scans.

    python -m benchmarks.calibrate --pairs 400 --out calibration/

The pairs are views of one scene from two places, rooms that are nearly bare, one object seen from two sides, and scans
dealt out to two and cut, some of them flattened; three tenths are scans of two different scenes, where no pose is
right. Many are thinned, noisy, or hold things that the other scan does not. Every pose that ``align`` would judge
counts, so that the wrong ones are the plausible ones. No real scan is involved. Prints the weights for
``fmr_cli/registration/confidence.py``, and draws how often the poses of each confidence are right, on the half of the
pairs that was not fitted.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.geometry.voxels import voxel_keys
from fmr_cli.registration import hypotheses
from fmr_cli.registration.confidence import Judge
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import KEYPOINTS, make_pair
from fmr_cli.registration.pipeline import COARSE_KEYPOINTS, COARSENESS, REFINED
from fmr_cli.registration.prepared import Prepared, pair_edge
from fmr_cli.registration.refinement import refined
from fmr_cli.synthetic import scenes, shapes
from fmr_cli.synthetic.pairs import degrade, scan_pair

RIGHT_DEGREES, RIGHT_EDGES = 5.0, 2.0
RIDGE = 3e-3
# What align has looked at when it ends: the first look on coarse voxels, local features, or the search as well.
KINDS = (("features",), ("features",), ("features", "search"))

Maker = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]


def scans(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, bool]:
    """Two scans, and whether they belong together; in the scene's frame where they do."""
    makers, odds = (scan_pair, bare_rooms, faces, halves), (0.35, 0.15, 0.2, 0.3)
    source, target = full_pair(makers[rng.choice(4, p=odds)], rng)
    together = rng.random() < 0.7
    if not together:
        source, _ = full_pair(makers[rng.choice(4, p=odds)], rng)
        if rng.random() < 0.7:  # of one size, whatever they are
            source = (source - source.mean(0)) * (np.ptp(target, axis=0).max() / np.ptp(source, axis=0).max())
    if rng.random() < 0.4:
        source, target = degrade(source, rng), degrade(target, rng)
    if rng.random() < 0.3:  # what moved, grew or was not there: up to a third of a scan is the scan's own
        source, target = clutter(source, rng), clutter(target, rng)
    return source, target, together


def full_pair(maker: Maker, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two scans, neither of which has missed the scene."""
    while True:
        source, target = maker(rng)
        if min(len(source), len(target)) >= 1000:
            return source, target


def bare_rooms(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Scans of a room that holds up to five things: turned by 90 or 180 deg it looks much the same."""
    scene = scenes.room(rng)
    held = [0, *rng.choice(np.arange(1, len(scene.kinds)), rng.integers(0, 6), replace=False)]
    scene = scenes.Scene([scene.kinds[i] for i in held], [scene.maps[i] for i in held])
    eye, heading = np.array([*rng.normal(0, 0.7, 2), rng.uniform(1, 1.8)]), rng.uniform(0, 2 * np.pi)
    first = scenes.room_scan(scene, rng, eye, heading)
    return first, scenes.room_scan(scene, rng, eye + rng.normal(0, 0.5, 3) * [1, 1, 0.3], heading + rng.normal(0, 0.6))


def thing(rng: np.random.Generator) -> np.ndarray:
    """An object all round, of any shape, some of them flattened: (20000, 3)."""
    makers = [shapes.shape, shapes.shape, *shapes.OTHERS]
    points = makers[rng.integers(len(makers))](rng, 20_000)
    flat = rng.uniform(0.01, 0.3) if rng.random() < 0.25 else 1.0  # sheets, reliefs
    return points * np.where(np.arange(3) == rng.integers(3), flat, 1.0)


def faces(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """What two cameras, 15 to 80 deg apart, see of one object."""
    points, towards = rng.permutation(thing(rng)), rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(rng.uniform(15, 80)) * unit(np.cross(towards, rng.normal(size=3))))
    return seen(points[::2], towards), seen(points[1::2], turn.apply(towards))


def seen(points: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """The points that hide each other least from a camera far away in the direction ``towards`` (3,)."""
    local = points @ Rotation.align_vectors([[0, 0, 1.0]], unit(towards)[None])[0].as_matrix().T
    cell = np.ptp(local, axis=0).max() / 50
    column = np.unique(voxel_keys((local - local.min(0)) * [1, 1, 0], cell), return_inverse=True)[1]
    top = np.full(column.max() + 1, -np.inf)
    np.maximum.at(top, column, local[:, 2])
    return points[local[:, 2] > top[column] - 3 * cell]


def halves(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The points of one scan dealt out to two, each of them cut by the same plane from its own side."""
    points = rng.permutation(thing(rng) if rng.random() < 0.7 else full_pair(scan_pair, rng)[0])
    depth, common = points @ unit(rng.normal(size=3)), rng.choice([1.0, rng.uniform(0.4, 1.0)])
    low, high = np.quantile(depth, [(1 - common) / (2 - common), 1 / (2 - common)])
    first = np.arange(len(points)) % 2 == 0
    return points[first & (depth >= low)], points[~first & (depth <= high)]


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def clutter(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The scan with points of its own in blobs about some of its points."""
    size = np.ptp(points, axis=0).max()
    blobs = [points]
    for _ in range(rng.integers(1, 40)):
        count = int(rng.uniform(0, 0.012) * len(points))
        spread = rng.uniform(0.003, 0.04, 3) * size
        blobs.append(points[rng.integers(len(points))] + rng.normal(size=(count, 3)) * spread)
    return np.concatenate(blobs)


def poses(seed: tuple[int, int]) -> list[tuple[np.ndarray, bool]]:
    """The evidence at each candidate pose of one fresh pair, and whether the pose is right."""
    rng = np.random.default_rng(seed)
    source, target, together = scans(rng)
    move = np.eye(4)
    move[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    kind = seed[1] % len(KINDS)
    try:
        prepared = Prepared(PointCloud(transform_points(move, source))), Prepared(PointCloud(target))
        coarseness, keypoints = (COARSENESS, COARSE_KEYPOINTS) if kind == 0 else (1.0, KEYPOINTS)
        pair = make_pair(*prepared, Options(seed=seed[1]), coarseness=coarseness, keypoints=keypoints)
    except RegistrationError:  # a street and a teacup: nothing to judge
        return []
    truth = pair.enter_centred(np.linalg.inv(move))
    features = hypotheses.from_features(pair)
    judge = Judge(pair, [(h.T_target_source, h.score) for h in [*features, *hypotheses.by_chance(pair)]])
    for name in KINDS[kind]:
        made = features if name == "features" else hypotheses.from_search(pair)
        for hypothesis in sorted(made, key=lambda h: -h.score)[:REFINED]:
            judge.consider(refined(pair, hypothesis), hypothesis.start, hypothesis.errors)
    found = []
    for c in judge.candidates:
        degrees, shift = pose_error(c.T_target_source, truth)
        near = shift < RIGHT_EDGES * pair_edge(*prepared) and degrees < RIGHT_DEGREES
        found.append((c.evidence.vector(), bool(together and near)))
    return found


def fit(x: np.ndarray, y: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Weights w by which the right pose of each pair, or "none of them", is most likely; a small ridge.

    x (n, k): the evidence; y (n,): right or not; pair (n,): the poses of one pair exclude each other. No kind of
    evidence may count against its own sense: what one kind happens to say about another in these scans need not hold
    elsewhere.
    """
    spread = np.append(1.0, x[:, 1:].std(0))
    some = np.bincount(pair) > 0
    none = np.bincount(pair, y)[some] == 0

    def loss(w: np.ndarray) -> float:
        odds = np.exp(np.clip((x / spread) @ w, -50, 50))
        each, right = (np.bincount(pair, o)[some] for o in (odds, odds * y))
        return float(np.mean(np.log1p(each) - np.log(np.where(none, 1, right))) + RIDGE * (w[1:] ** 2).mean())

    bounds = [(None, None)] + [(0, None)] * (x.shape[1] - 1)
    return minimize(loss, np.zeros(x.shape[1]), method="L-BFGS-B", bounds=bounds).x / spread


def best(x: np.ndarray, y: np.ndarray, pair: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What ``align`` would say of each pair: the confidence of its best pose, and whether that is right."""
    groups = [np.flatnonzero(pair == i) for i in np.unique(pair)]
    odds = np.exp(np.clip(x @ weights, -50, 50))
    first = [here[odds[here].argmax()] for here in groups]
    return np.array([odds[i] / (1 + odds[here].sum()) for i, here in zip(first, groups, strict=True)]), y[first]


def report(p: np.ndarray, y: np.ndarray) -> str:
    lines = ["confidence   pairs  right"]
    for low, high in ((0, 0.1), (0.1, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.01)):
        here = (p >= low) & (p < high)
        lines.append(
            f"{low:.2f} to {min(high, 1):.2f}  {here.sum():5d}  {y[here].mean() if here.any() else np.nan:.3f}"
        )
    called = p >= 0.5
    lines.append(f"aligned: precision {y[called].mean():.4f}, recall of right poses {called[y].mean():.4f}")
    return "\n".join(lines)


def draw(p: np.ndarray, y: np.ndarray, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    edges = np.quantile(p, np.linspace(0, 1, 11))
    bins = [(p >= a) & (p <= b) for a, b in itertools.pairwise(edges)]
    figure, axes = plt.subplots(figsize=(5, 5))
    axes.plot([0, 1], [0, 1], color="0.7")
    axes.plot([p[b].mean() for b in bins], [y[b].mean() for b in bins], "o-")
    axes.set(xlabel="confidence", ylabel="share that is right", title=f"{len(p)} pairs not fitted")
    figure.savefig(path, dpi=120, bbox_inches="tight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=400)
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--out", type=Path, default=Path("calibration"))
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True, parents=True)
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(poses, [(args.seed, i) for i in range(args.pairs)], chunksize=4))
    np.savez(
        args.out / "evidence.npz", x=[v for pair in found for v, _ in pair], y=[r for pair in found for _, r in pair],
        pair=[i for i, pair in enumerate(found) for _ in pair],
    )  # fmt: skip
    data = np.load(args.out / "evidence.npz")
    x, y, pair = data["x"], data["y"], data["pair"]
    fitted = pair % (2 * len(KINDS)) < len(KINDS)  # half of each of the kinds
    p, right = best(x[~fitted], y[~fitted], pair[~fitted], fit(x[fitted], y[fitted], pair[fitted]))
    print(f"{len(y)} poses of {args.pairs} pairs, {y.mean():.3f} of them right; judged on the half not fitted:")
    print(report(p, right))
    print("WEIGHTS, fitted on all:", np.round(fit(x, y, pair), 3).tolist())
    draw(p, right, args.out / "calibration.png")


if __name__ == "__main__":
    main()
