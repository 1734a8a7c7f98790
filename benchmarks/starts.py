"""Which starts find the pose: recall before and after refinement, and seconds, for each way to start.

    python -m benchmarks.starts                   # procedural pairs, part overlap, any rotation
    python -m benchmarks.starts --data FOLDER     # FOLDER/*.ply with *.pose.txt (cloud to world), 30 % overlap and more
    python -m benchmarks.starts --where           # where the default's pairs come from, protocol by protocol
    python -m benchmarks.starts --where --data FOLDER  # the same on FOLDER's pairs, turned by up to 60 deg

search and features are this tool's own. FPFH + RANSAC (Open3D) and KISS-Matcher take their place where installed, on
the same voxel edge; each then goes through the same refinement. A start counts as found within 15 degrees and 6 voxel
edges, a refined pose within 5 degrees and 2.

--where: which start `fmr align` ended with, and what its first look costs as it is (local features) and if it were the
paper's IC solver from the centroids and from the poses as they are, on few points. A look ends the search where its
verdict is sure; an IC that is not has only cost time. Columns: the share of pairs that align has right; CPU seconds
(which other work on the machine changes less than wall time) of all of align, of describing and matching (the verdict
counts the matches that agree with a pose, whatever its start), of the first look by features, of the two ICs alone, of
the first look by IC, each look from prepared clouds to the verdict; the share of pairs that each look has sure and
right, or right; and what align would take with the look by IC before the usual one.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.common import PROTOCOLS, random_pose, room_clouds, shape_clouds, show
from benchmarks.common import make_pair as protocol_pair
from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.evaluation.baselines import global_baselines
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.io import read_cloud
from fmr_cli.registration.confidence import Judge
from fmr_cli.registration.hypotheses import Hypothesis, from_features, from_search, from_solver
from fmr_cli.registration.looks import FIRST, SURE, consider
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.pipeline import align, one_blas_thread
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.refinement import refined, roughly
from fmr_cli.registration.result import Stopwatch
from fmr_cli.synthetic.pairs import scan_pair

FEW = Options(points=512, iterations=6)  # of the IC trial: about half of what --init centroid takes
POINTS = 12_288  # of a cloud of the protocols

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


def from_folder(folder: Path, count: int, seed: int, degrees: float | None = None) -> Iterator[Problem]:
    """Pairs of scans with poses, turned by any rotation, or by up to ``degrees``."""
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
        source, target, T = pairs[i]
        if degrees is None:
            yield turned(source, target, T, rng)
            continue
        middle, X = transform_points(T, source).mean(0), random_pose(rng, degrees, 0.0)
        X[:3, 3] = middle - X[:3, :3] @ middle
        yield transform_points(X @ T, source), target, np.linalg.inv(X)


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


def by_ic(pair: Pair) -> list[Hypothesis]:
    """The paper's solver from the centroids and from the poses as they are; refined the cheap way, as by features."""
    starts = np.eye(4), pair.enter_centred(np.eye(4))
    return [replace(h, start="features") for T in starts for h in from_solver(pair, T, "centroid")]


def first_look(problem: Problem, way: Callable[[Pair], list[Hypothesis]], options: Options) -> tuple[float, bool, bool]:
    """The first look at a pair by one kind of start: CPU seconds, whether the verdict is sure, and is right."""
    source, target, truth = problem
    pair = make_pair(Prepared(PointCloud(source)), Prepared(PointCloud(target)), options, 1, *FIRST)
    begin = time.process_time()
    judge = Judge(pair)
    consider(judge, way(pair), Stopwatch())
    took = time.process_time() - begin
    if not judge.candidates:
        return took, False, False
    return took, judge.sure(SURE), right(pair, pair.leave_centred(judge.best.T_target_source), truth)


def right(pair: Pair, T: np.ndarray, truth: np.ndarray) -> bool:
    """Within 5 degrees, and 4 voxel edges at the source's centre."""
    degrees, shift = pose_error(T, truth, pair.source.centre)
    return bool(degrees < 5 and shift < 4 * pair.edge)


def where(problems: Iterator[Problem]) -> dict[str, object]:
    """A row of the table of --where."""
    starts, rows = Counter[str](), []
    for problem in problems:
        source, target, truth = problem
        begin = time.process_time()
        found = align(PointCloud(source), PointCloud(target), Options(), 1)
        whole = time.process_time() - begin
        starts[found.start] += 1
        pair = make_pair(Prepared(PointCloud(source)), Prepared(PointCloud(target)), Options(), 1, *FIRST)
        begin = time.process_time()
        _ = pair.matches
        matching = time.process_time() - begin
        features, ic = first_look(problem, from_features, Options()), first_look(problem, by_ic, FEW)
        pair = make_pair(Prepared(PointCloud(source)), Prepared(PointCloud(target)), FEW, 1, *FIRST)
        begin = time.process_time()
        by_ic(pair)
        solving = time.process_time() - begin
        rows.append((right(pair, found.T_target_source, truth), whole, matching, solving, *features, *ic))
    right_, whole, matching, solving, f_took, f_sure, f_right, i_took, i_sure, i_right = np.array(rows, float).T
    return {
        "pairs": len(rows), "start": ", ".join(f"{name} {n}" for name, n in starts.most_common()),
        "right": right_.mean(), "align": np.median(whole), "match": np.median(matching),
        "look": np.median(f_took), "sure": (f_sure * f_right).mean(),
        "IC": np.median(solving), "IC look": np.median(i_took), "IC right": i_right.mean(),
        "IC sure": (i_sure * i_right).mean(),
        "IC first": np.median(whole + i_took - np.where(i_sure, f_took, 0)),  # what is not sure goes the usual way
    }  # fmt: skip


def by_protocol(count: int, seed: int) -> None:
    """The table of --where on made-up rooms and objects."""
    rows = []
    for name, clouds in (("rooms", room_clouds(count, POINTS, seed)), ("objects", shape_clouds(count, POINTS, seed))):
        for number, protocol in enumerate(PROTOCOLS):
            rng = np.random.default_rng((seed, number))
            problems = (protocol_pair(protocol, cloud, rng) for cloud in clouds)
            rows.append({"clouds": name, "protocol": protocol, **where(problems)})
    show("Where the default's pairs come from; CPU seconds", rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=30_000)
    parser.add_argument("--where", action="store_true")
    args = parser.parse_args()
    if args.where:
        with one_blas_thread():
            if args.data:
                row = where(from_folder(args.data, args.pairs, args.seed, 60.0))
                show("Where the default's pairs come from; CPU seconds", [{"clouds": args.data.name, **row}])
            else:
                by_protocol(args.pairs, args.seed)
        return
    problems = from_folder(args.data, args.pairs, args.seed) if args.data else procedural(args.pairs, args.seed)
    ways = starts()
    outcomes: dict[str, list[tuple[bool, bool, float]]] = {name: [] for name in ways}
    for source, target, truth in problems:
        for name, way in ways.items():  # each prepares the clouds anew, and so pays for its own features
            pair = make_pair(Prepared(PointCloud(source)), Prepared(PointCloud(target)), Options())
            T = pair.enter_centred(truth)
            begin = time.perf_counter()
            found = way(pair)
            took = time.perf_counter() - begin
            best = max(found, key=lambda h: h.score) if found else Hypothesis(np.eye(4), name)
            degrees, shift = pose_error(np.stack([best.T_target_source, *refined(pair, roughly(pair, [best]))]), T)
            near = (degrees < (15, 5)) & (shift < np.array([6, 2]) * pair.edge)
            outcomes[name].append((*near, took))
    print(f"{'start':16s} pairs  found  refined  median s")
    for name, several in outcomes.items():
        found_share, refined_share, seconds = np.array(several, float).T
        said = f"{found_share.mean():.3f}  {refined_share.mean():.3f}    {np.median(seconds):.3f}"
        print(f"{name:16s} {len(several):5d}  {said}")


if __name__ == "__main__":
    main()
