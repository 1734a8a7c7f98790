"""Calibrate the verdict: logistic regression on the evidence at right and wrong poses of procedural scans.

    python -m benchmarks.calibrate --pairs 400 --out calibration/

Half of the pairs are two scans of one scene, from little to full overlap; a fifth are halves of one scan, some of them
flattened; the others are scans of two different scenes, where no pose is right. Many are thinned, noisy, or hold things
that the other scan does not. Every pose that ``align`` would judge counts,
so that the wrong ones are the plausible ones. No real scan is involved. Prints the weights for ``fmr_cli/verdict.py``,
and draws how often the poses of each confidence are right, on the half of the pairs that was not fitted.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.errors import RegistrationError
from fmr_cli.pair import Prepared
from fmr_cli.registration import REFINED, Options, local_pose, make_pair
from fmr_cli.training.local import degrade, scan_pair

RIGHT_DEGREES, RIGHT_EDGES = 5.0, 2.0
RIDGE = 3e-3


def scans(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, bool]:
    """Two scans, and whether they belong together; in the scene's frame where they do."""
    source, target = full_pair(rng)
    kind = rng.choice(["views", "halves", "strangers"], p=[0.5, 0.2, 0.3])
    if kind == "strangers":
        source, _ = full_pair(rng)
    if kind == "halves":
        if rng.random() < 0.3:  # sheets, reliefs
            target = target * np.where(np.arange(3) == rng.integers(3), rng.uniform(0.01, 0.3), 1.0)
        order = rng.permutation(len(target))
        source, target = target[order[::2]], target[order[1::2]]
    if rng.random() < 0.4:
        source, target = degrade(source, rng), degrade(target, rng)
    if rng.random() < 0.4:  # what moved, grew or was not there: up to a third of a scan is the scan's own
        source, target = clutter(source, rng), clutter(target, rng)
    return source, target, kind != "strangers"


def full_pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two scans of one scene, neither of which has missed it."""
    while True:
        source, target = scan_pair(rng)
        if min(len(source), len(target)) >= 2000:
            return source, target


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
    try:
        pair = make_pair(
            Prepared(PointCloud(transform_points(move, source))), Prepared(PointCloud(target)), Options(seed=seed[1])
        )
    except RegistrationError:  # a street and a teacup: nothing to judge
        return []
    truth = local_pose(np.linalg.inv(move), pair)
    found = []
    for starts in (pair.from_features, pair.from_search):
        for start in sorted(starts(), key=lambda s: -pair.coincidence(s.T))[:REFINED]:
            candidate = pair.candidate(start, polished=True, scale=False)
            error = np.linalg.inv(truth) @ candidate.T
            near = np.linalg.norm(error[:3, 3]) < RIGHT_EDGES * pair.edge
            right = together and near and angle_degrees(error) < RIGHT_DEGREES
            found.append((candidate.evidence.vector(), bool(right)))
    return found


def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Weights w that minimise the logistic loss of y (0/1) on x w, with a small ridge on the standardised columns.

    No kind of evidence may count against its own sense: what one kind happens to say about another in these scans need
    not hold elsewhere.
    """
    spread = np.append(1.0, x[:, 1:].std(0))

    def loss(w: np.ndarray) -> float:
        z = (x / spread) @ w
        return float(np.mean(np.logaddexp(0, z) - y * z) + RIDGE * (w[1:] ** 2).mean())

    bounds = [(None, None)] + [(0, None)] * (x.shape[1] - 1)
    return minimize(loss, np.zeros(x.shape[1]), method="L-BFGS-B", bounds=bounds).x / spread


def report(p: np.ndarray, y: np.ndarray) -> str:
    lines = ["confidence   poses  right"]
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
    axes.set(xlabel="confidence", ylabel="share that is right", title=f"{len(p)} poses not fitted")
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
    x, y, held = data["x"], data["y"], data["pair"] % 2 == 1
    weights = fit(x[~held], y[~held])
    p = 1 / (1 + np.exp(-x[held] @ weights))
    print(f"{len(y)} poses of {args.pairs} pairs, {y.mean():.3f} of them right; judged on the half not fitted:")
    print(report(p, y[held]))
    print("WEIGHTS, fitted on all:", np.round(fit(x, y), 3).tolist())
    draw(p, y[held], args.out / "calibration.png")


if __name__ == "__main__":
    main()
