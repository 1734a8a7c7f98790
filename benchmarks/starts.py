"""Which starts find the pose: recall before and after refinement, and seconds, for each way to start.

    python -m benchmarks.starts                   # procedural pairs, part overlap, any rotation
    python -m benchmarks.starts --data FOLDER     # FOLDER/*.ply with *.pose.txt (cloud to world), 30 % overlap and more

search and features are this tool's own. FPFH + RANSAC (Open3D) and KISS-Matcher take their place where installed, on
the same voxel edge; each then goes through the same refinement. A start counts as found within 15 degrees and 6 voxel
edges, a refined pose within 5 degrees and 2.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.evaluation.baselines import global_baselines
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.io import read_cloud
from fmr_cli.registration.hypotheses import Hypothesis, from_features, from_search
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.refinement import refined
from fmr_cli.synthetic.pairs import scan_pair

Problem = tuple[np.ndarray, np.ndarray, np.ndarray]  # source, target, T_target_source


def turned(source: np.ndarray, target: np.ndarray, T: np.ndarray, rng: np.random.Generator) -> Problem:
    """The pair with the source turned by any rotation."""
    X = np.eye(4)
    X[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    return transform_points(X, source), target, T @ np.linalg.inv(X)


def procedural(count: int, seed: int) -> Iterator[Problem]:
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        yield turned(*scan_pair(rng), np.eye(4), rng)


def from_folder(folder: Path, count: int, seed: int) -> Iterator[Problem]:
    rng = np.random.default_rng(seed)
    scans = [(read_cloud(p).points, np.loadtxt(p.with_suffix(".pose.txt"))) for p in sorted(folder.glob("*.ply"))]
    pairs = []
    for (target, pose_t), (source, pose_s) in itertools.combinations(scans, 2):
        T = np.linalg.inv(pose_t) @ pose_s
        moved = transform_points(T, source)
        near = 1.5 * np.median(cKDTree(target).query(target, 2)[0][:, 1])
        overlap = min(np.mean(cKDTree(a).query(b)[0] < near) for a, b in ((target, moved), (moved, target)))
        if overlap > 0.3:
            pairs.append((source, target, T))
    for i in rng.permutation(len(pairs))[:count]:
        yield turned(*pairs[i], rng)


def from_peer(name: str, pair: Pair) -> list[Hypothesis]:
    """Where another tool would start, told the pair's voxel edge."""
    T = global_baselines(pair.edge)[0][name](pair.source.points, pair.target.points)
    return [Hypothesis(T, "features", pair.overlap_score(T))]


def starts() -> dict[str, Callable[[Pair], list[Hypothesis]]]:
    """Every way to start that can run here; says which cannot."""
    there, missing = global_baselines(1.0)
    for line in missing:
        print(line)
    return {"search": from_search, "features": from_features, **{name: partial(from_peer, name) for name in there}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=30_000)
    args = parser.parse_args()
    problems = from_folder(args.data, args.pairs, args.seed) if args.data else procedural(args.pairs, args.seed)
    ways = starts()
    rows: dict[str, list[tuple[bool, bool, float]]] = {name: [] for name in ways}
    for source, target, truth in problems:
        for name, way in ways.items():  # each prepares the clouds anew, and so pays for its own features
            pair = make_pair(Prepared(PointCloud(source)), Prepared(PointCloud(target)), Options())
            T = pair.enter_centred(truth)
            begin = time.perf_counter()
            found = way(pair)
            took = time.perf_counter() - begin
            best = max(found, key=lambda h: h.score) if found else Hypothesis(np.eye(4), name)
            degrees, shift = pose_error(np.stack([best.T_target_source, refined(pair, best)]), T)
            right = (degrees < (15, 5)) & (shift < np.array([6, 2]) * pair.edge)
            rows[name].append((*right, took))
    print(f"{'start':16s} pairs  found  refined  median s")
    for name, row in rows.items():
        found_share, right, seconds = np.array(row, float).T
        print(f"{name:16s} {len(row):5d}  {found_share.mean():.3f}  {right.mean():.3f}    {np.median(seconds):.3f}")


if __name__ == "__main__":
    main()
