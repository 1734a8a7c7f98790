"""Recall and error on the paper's protocols, fmr beside the tools a user would pick instead.

    python -m benchmarks.accuracy                          # rooms and objects that the project makes itself
    python -m benchmarks.accuracy --data FOLDER            # every point cloud of a folder
    python -m benchmarks.accuracy --out benchmarks/accuracy    # also accuracy.json and accuracy.png
    python -m benchmarks.accuracy --quick                  # in two minutes

A pair counts as found within 5 degrees and 0.1 units. The peers are told a voxel size that fits; fmr is told nothing.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import (
    PROTOCOLS,
    console,
    folder_clouds,
    make_pair,
    room_clouds,
    save,
    shape_clouds,
    show,
    ways,
)
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.report import plots

DEGREES, SHIFT = 5.0, 0.1  # of a pose that counts as found


def measure(clouds: list[np.ndarray], protocol: str, methods: dict, pairs: int, seed: int) -> list[dict[str, Any]]:
    """A row for each method: the same pairs for all, one after the other."""
    rng = np.random.default_rng(seed)
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in methods}
    for number in range(pairs):
        source, target, truth = make_pair(protocol, clouds[number % len(clouds)], rng)
        for name, way in methods.items():
            begin = time.perf_counter()
            T = way(source, target)
            took = time.perf_counter() - begin
            found[name].append((*pose_error(T, truth, source.mean(0)), took))
    rows = []
    for name, results in found.items():
        degrees, shift, seconds = np.array(results).T
        good = (degrees < DEGREES) & (shift < SHIFT)
        rows.append({
            "protocol": protocol, "method": name, "pairs": pairs, "recall": float(good.mean()),
            "median deg": float(np.median(degrees)), "median shift": float(np.median(shift)),
            "median s": float(np.median(seconds)),
        })  # fmt: skip
    return rows


def plot(figure: Any, rows: list[dict[str, Any]]) -> None:
    """A panel for each set of clouds: recall by protocol with its 95 % binomial interval, a dot for each method."""
    sets, methods, protocols = (list(dict.fromkeys(row[k] for row in rows)) for k in ("clouds", "method", "protocol"))
    panels = figure.subplots(1, len(sets), squeeze=False, sharey=True)[0]
    for panel, name in zip(panels, sets, strict=True):
        series = []
        for method in methods:
            own = [row for row in rows if (row["clouds"], row["method"]) == (name, method)]
            low, high = zip(*(plots.binomial(row["recall"], row["pairs"]) for row in own), strict=True)
            at = [protocols.index(row["protocol"]) for row in own]
            series.append(plots.Series(method, at, [row["recall"] for row in own], low, high))
        plots.dots(panel, protocols, series)
        panel.set(title=name, xlim=(0, 1.02), xlabel=f"recall ({DEGREES:g} deg, {SHIFT:g}), 95 % interval")
    plots.names_above(figure, methods)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="a folder of point clouds, in place of those made here")
    parser.add_argument("--points", type=int, default=12_288, help="of a cloud made here, at most of a file")
    parser.add_argument("--pairs", type=int, default=40, help="of each protocol and set of clouds")
    parser.add_argument("--only", default=",".join(PROTOCOLS), help="protocols, comma-separated")
    parser.add_argument("--methods", help="those whose name has this in it")
    parser.add_argument("--voxel-size", type=float, default=0.05, help="the peers', in the clouds' unit")
    parser.add_argument("--seed", type=int, default=40_000)
    parser.add_argument("--out", type=Path, help="write OUT.json and OUT.png")
    parser.add_argument("--quick", action="store_true", help="6 pairs of each")
    args = parser.parse_args()
    pairs = 6 if args.quick else args.pairs
    if args.data:
        sets = {args.data.name: folder_clouds(args.data, args.points, args.seed)}
    else:
        count = min(pairs, 20)
        sets = {
            "rooms": room_clouds(count, args.points, args.seed),
            "objects": shape_clouds(count, args.points, args.seed),
        }
    methods = {n: way for n, way in ways(args.voxel_size, 4 * args.voxel_size).items() if (args.methods or "") in n}
    rows: list[dict[str, Any]] = []
    for name, clouds in sets.items():
        console.print(f"{name}: {len(clouds)} clouds of {np.median([len(c) for c in clouds]):,.0f} points")
        for protocol in args.only.split(","):
            rows += [{"clouds": name, **row} for row in measure(clouds, protocol, methods, pairs, args.seed)]
        show(name, [row for row in rows if row["clouds"] == name])
    save(args.out, {"rows": rows, "arguments": {k: str(v) for k, v in vars(args).items()}}, lambda f: plot(f, rows))


if __name__ == "__main__":
    main()
