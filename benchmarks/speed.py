"""How long it takes, beside what a user would pick instead, in the same run; medians of interleaved repeats.

    python -m benchmarks.speed                             # all, on rooms that the project makes itself
    python -m benchmarks.speed --only ic,align             # parts: ic align process batch las growth gpu
    python -m benchmarks.speed --data FOLDER               # on the point clouds of a folder
    python -m benchmarks.speed --las-points 20000000       # the LAS files' size
    python -m benchmarks.speed --out benchmarks/speed      # also speed.json and speed.png
    python -m benchmarks.speed --quick                     # in two minutes: fewer repeats, smaller files

Peers that are not installed are skipped with a line. The machine should have nothing else to do.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from benchmarks.common import (
    CORES,
    console,
    folder_clouds,
    interleaved,
    make_pair,
    room_clouds,
    save,
    show,
    ways,
)
from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.io import write_cloud
from fmr_cli.registration.models import bundled_encoder, fast_encoder
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import align
from fmr_cli.report import plots

Row = dict[str, Any]
Rows = list[Row]
FMR = [sys.executable, "-c", "from fmr_cli.cli.app import main; main()"]  # what the command `fmr` runs


@dataclass
class Setup:
    """clouds: (N, 3) each; voxel: the peers' edge; repeats: of each run; the sizes of what is made here."""

    clouds: list[np.ndarray]
    voxel: float
    repeats: int
    batch: int
    las_points: int
    sizes: list[int]
    seed: int


def row(
    what: str, seconds: list[float], reference: list[float] | None = None, more: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Median and quartiles; ``times``: how many times faster than the reference, by the medians."""
    low, middle, high = np.quantile(seconds, [0.25, 0.5, 0.75])
    times = {} if reference is None else {"times faster": float(np.median(reference) / middle)}
    return {"what": what, "s": float(middle), "quartiles": f"{low:.4g} - {high:.4g}", **times, **(more or {})}


def ic(setup: Setup) -> Rows:
    """IC alone, 10 iterations, source and target the same points: the paper's algorithm in PyTorch, and this solver."""
    import torch

    from benchmarks import paper
    from fmr_cli.feature_metric.solver import make_template, solve

    torch.set_num_threads(CORES)
    encoder = bundled_encoder()
    fast = fast_encoder()
    rng = np.random.default_rng(setup.seed)
    source, target, truth = make_pair("copy", setup.clouds[0], rng)
    length = 2 * np.abs(target - target.mean(0)).max()
    Q, P = (((x - x.mean(0)) / length).astype(np.float32) for x in (source, target))
    q, p = torch.from_numpy(Q)[None], torch.from_numpy(P)[None]
    nets = {name: paper.PointNet(encoder, "batch" in name) for name in ("PyTorch", "PyTorch, batch norms of PointNet")}

    def plain() -> Any:
        with torch.inference_mode():
            return solve(encoder, make_template(encoder, p), q, torch.eye(4)[None], 10, False).g

    runs: dict[str, Callable[[], Any]] = {name: partial(paper.solve, net, q, p) for name, net in nets.items()}
    runs["our plain solver in PyTorch"] = plain

    def ours(threads: int) -> Any:
        return fast.solve(fast.template(P, threads), Q, np.eye(4)[None], 10, False, threads=threads).g

    runs["fmr, 1 thread, all points in every iteration"] = lambda: (
        fast.solve_all(fast.template(P), Q, np.eye(4)[None], 10, False, None, map).g
    )
    runs |= {f"fmr, {threads} threads": partial(ours, threads) for threads in sorted({1, CORES})}
    with ThreadpoolController().limit(limits=1, user_api="blas"):
        found = {name: np.asarray(run())[0].astype(float) for name, run in runs.items()}
        seconds = interleaved(runs, setup.repeats, warm=True)
    off = {name: float(pose_error(T, truth)[0]) for name, T in found.items()}
    return [row(name, s, seconds["PyTorch"], more={"off, deg": off[name]}) for name, s in seconds.items()]


def whole(setup: Setup) -> Rows:
    """align() on points in memory, beside the peers; then its own stages."""
    rows = []
    methods = ways(setup.voxel, 4 * setup.voxel)
    for protocol, title in (("copy", "up to 60 deg"), ("so3", "any rotation"), ("resample", "resampled, up to 60 deg")):
        rng = np.random.default_rng(setup.seed)
        pairs = [make_pair(protocol, cloud, rng) for cloud in setup.clouds]
        seconds: dict[str, list[float]] = {name: [] for name in methods}
        right = dict.fromkeys(methods, 0)
        for source, target, truth in pairs:
            runs = {name: partial(way, source, target) for name, way in methods.items()}
            for name, s in interleaved(runs, setup.repeats).items():
                seconds[name] += s
                degrees, _ = pose_error(methods[name](source, target), truth, source.mean(0))
                right[name] += degrees < 5
        peer = next((s for name, s in seconds.items() if name.startswith("KISS")), None)
        rows += [
            row(f"{title}: {name}", s, peer, {"found": f"{right[name]}/{len(pairs)}"}) for name, s in seconds.items()
        ]
    source, target, _ = make_pair("copy", setup.clouds[0], np.random.default_rng(setup.seed))
    stages = [align(PointCloud(source), PointCloud(target), Options(), CORES).seconds for _ in range(setup.repeats)]
    return rows + [row(f"stage {name}", [s[name] for s in stages]) for name in stages[0]]


def run_process(command: list[str]) -> tuple[float, float]:
    """Seconds and peak memory in GiB of a command; raises where it fails."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdout=said, stderr=said, env={**os.environ, "PYTHONWARNINGS": "ignore"})
        _, status, usage = os.wait4(process.pid, 0)
        said.seek(0)
        if os.waitstatus_to_exitcode(status) not in (0, 3):  # 3: done, but uncertain
            raise SystemExit(f"{' '.join(command)}: {said.read().decode()[-1000:]}")
    return time.perf_counter() - begin, usage.ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def write_pairs(folder: Path, setup: Setup, count: int) -> list[tuple[Path, Path]]:
    rng, files = np.random.default_rng(setup.seed), []
    for number in range(count):
        source, target, _ = make_pair("copy", setup.clouds[number % len(setup.clouds)], rng)
        files.append((folder / f"{number}_source.ply", folder / f"{number}_target.ply"))
        for path, points in zip(files[-1], (source, target), strict=True):
            write_cloud(path, PointCloud(points))
    return files


def process(setup: Setup) -> Rows:
    """`fmr align a.ply b.ply` from its start to its end, beside the start of Python with torch and Open3D."""
    with tempfile.TemporaryDirectory() as folder:
        (a, b), *_ = write_pairs(Path(folder), setup, 1)
        commands = {"fmr align a.ply b.ply": [*FMR, "align", str(a), str(b)], "fmr --help": [*FMR, "--help"]}
        for modules in ("torch", "torch, open3d"):
            start = [sys.executable, "-c", f"import {modules}"]
            if subprocess.run(start, capture_output=True, check=False).returncode == 0:
                commands[f"python -c 'import {modules}'"] = start
        seconds = interleaved(
            {name: partial(run_process, command) for name, command in commands.items()}, setup.repeats
        )
    return [row(name, s) for name, s in seconds.items()]


def batch(setup: Setup) -> Rows:
    """`fmr batch` on many pairs, beside the same pairs as a process each (a few of them, extrapolated)."""
    with tempfile.TemporaryDirectory() as name:
        folder, few = Path(name), 3
        files = write_pairs(folder, setup, setup.batch)
        lines = ["source,target", *(f"{a.name},{b.name}" for a, b in files)]
        (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
        together, memory = run_process([*FMR, "batch", str(folder / "pairs.csv"), "--out", str(folder / "out")])
        alone = [run_process([*FMR, "align", str(a), str(b)])[0] for a, b in files[:few]]
    one = float(np.median(alone))
    return [
        {"what": f"fmr batch, {len(files)} pairs", "s": together, "a pair": together / len(files),
         "times faster": one * len(files) / together, "GiB": memory},
        {"what": "fmr align, a process a pair", "s": one * len(files), "a pair": one},
    ]  # fmt: skip


def write_las(path: Path, base: np.ndarray, count: int, T: np.ndarray, seed: int) -> None:
    """``count`` points about those of base (N, 3), 1 cm off, moved by T; written a million at a time."""
    import laspy

    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-3), np.zeros(3)
    rng = np.random.default_rng(seed)
    with laspy.open(path, "w", header=header) as file:
        for first in range(0, count, 1_000_000):
            size = min(1_000_000, count - first)
            x = transform_points(T, base[rng.integers(len(base), size=size)] + rng.normal(0, 0.01, (size, 3)))
            record = laspy.ScaleAwarePointRecord.zeros(size, header=header)
            record.x, record.y, record.z = x.T
            file.write_points(record)


def las(setup: Setup) -> Rows:
    """`fmr align` on two large LAS files: seconds, peak memory, and what reading them alone takes."""
    base = room_clouds(1, min(300_000, setup.las_points), setup.seed)[0]
    T = make_pair("copy", base[:10], np.random.default_rng(setup.seed))[2]
    read = "import sys; from fmr_cli.io import read_cloud; [read_cloud(p, attributes=False) for p in sys.argv[1:]]"
    with tempfile.TemporaryDirectory() as name:
        files = [Path(name) / "a.las", Path(name) / "b.las"]
        for number, (path, pose) in enumerate(zip(files, (np.eye(4), T), strict=True)):
            write_las(path, base, setup.las_points, pose, number)
        metrics = Path(name) / "metrics.json"
        together, memory = run_process([*FMR, "align", *map(str, files), "--metrics", str(metrics)])
        said = json.loads(metrics.read_text())
        reading, _ = run_process([sys.executable, "-c", read, *map(str, files)])
    off = pose_error(np.array(said["T_target_source"]), T, base.mean(0))
    size = f"2 x {setup.las_points / 1e6:g} million points"
    return [
        {"what": f"fmr align, {size}", "s": together, "GiB": memory, "status": said["status"], "off, deg": off[0]},
        {"what": "reading them alone", "s": reading, "share": reading / together},
    ]


def growth(setup: Setup) -> Rows:
    """align() on 1,000 to 1,000,000 points of one room, beside the peers."""
    cloud, rows = room_clouds(1, max(setup.sizes), setup.seed)[0], []
    methods = ways(setup.voxel, 4 * setup.voxel)
    for size in setup.sizes:
        source, target, truth = make_pair("copy", cloud[:size], np.random.default_rng(setup.seed))
        repeats = setup.repeats if size < 100_000 else min(setup.repeats, 3)
        runs = {name: partial(way, source, target) for name, way in methods.items()}
        for name, s in interleaved(runs, repeats).items():
            off, _ = pose_error(methods[name](source, target), truth, source.mean(0))
            rows.append(row(f"{size:,} points: {name}", s, None, {"method": name, "points": size, "off, deg": off}))
    return rows


def gpu(setup: Setup) -> Rows:
    """Pairs a second in batches through the solver, and training samples a second: on the CPU and on a GPU."""
    import torch

    from fmr_cli.feature_metric.encoder import Encoder
    from fmr_cli.feature_metric.solver import make_template, solve
    from fmr_cli.geometry import se3
    from fmr_cli.training.losses import pose_loss

    @torch.inference_mode()
    def register(encoder: Encoder, source: Any, points: Any, start: Any) -> None:
        float(solve(encoder, make_template(encoder, points), source, start).g.sum())  # waits for the device

    def train(encoder: Encoder, source: Any, points: Any, T: Any) -> None:
        loss = pose_loss(encoder, source, points, T, 5)
        loss.backward()
        loss.item()

    rows = []
    for device in ("cpu", *(["cuda"] if torch.cuda.is_available() else [])):
        size = 512 if device == "cuda" else 16
        points = torch.from_numpy(np.stack([c[:1024] for c in setup.clouds * size])[:size]).float().to(device)
        points = points - points.mean(1, keepdim=True)
        points = points / (2 * points.abs().amax((1, 2), keepdim=True))
        twist = torch.tensor([0.3, 0.2, 0.4, 0.02, 0.03, 0.01], device=device)
        T = se3.exp(twist).expand(size, 4, 4)
        source = se3.transform(torch.linalg.inv(T), points)
        encoder, start = bundled_encoder().to(device), torch.eye(4, device=device).expand(size, 4, 4)
        runs = {
            "pairs": partial(register, encoder, source, points, start),
            "training samples": partial(train, Encoder().to(device), source, points, T),
        }
        for what, s in interleaved(runs, setup.repeats).items():
            rows.append(row(f"{device}: {what}, {size} at once", s, None, {"a second": size / float(np.median(s))}))
        encoder.cpu()
    if not torch.cuda.is_available():
        console.print("cuda: skipped (this machine has no usable GPU)")
    return rows


PARTS: dict[str, Callable[[Setup], Rows]] = {
    "ic": ic, "align": whole, "process": process, "batch": batch, "las": las, "growth": growth, "gpu": gpu,
}  # fmt: skip


def plot(figure: Any, report: dict[str, Rows]) -> None:
    """A panel each, where measured: IC alone, the whole registration, its growth with the number of points."""
    left = [part for part in ("ic", "align") if part in report]
    right = ["growth"] if "growth" in report else []
    rows = [[part, *right] for part in left] or [right or ["none"]]
    panels = figure.subplot_mosaic(rows, width_ratios=[1, 1] if left and right else None)
    if "ic" in report:
        names = [r["what"] for r in report["ic"]]
        colors = [plots.COLORS[0] if "fmr" in name else plots.COLORS[4] for name in names]
        drawn = panels["ic"].barh(names, [r["s"] for r in report["ic"]], color=colors, height=0.6)
        panels["ic"].bar_label(drawn, [f"{r['s']:.2g} s" for r in report["ic"]], padding=2, fontsize=7)
        panels["ic"].set(title="IC alone", xlabel="s", xmargin=0.2)
        panels["ic"].invert_yaxis()
        panels["ic"].grid(axis="y", visible=False)
    if "align" in report:
        situations, series = situation_series([r for r in report["align"] if not r["what"].startswith("stage")])
        plots.dots(panels["align"], situations, series)
        panels["align"].set(title="registration", xlabel="s", xlim=(0, None))
        plots.names_above(figure, [s.label for s in series])
    if "growth" in report:
        own: dict[str, Rows] = {}
        for r in report["growth"]:
            own.setdefault(r["method"], []).append(r)
        panels["growth"].set(title="registration", xlabel="points", ylabel="s", xscale="log", yscale="log")
        lines = [plots.Series(m, [r["points"] for r in rs], [r["s"] for r in rs]) for m, rs in own.items()]
        plots.curves(panels["growth"], lines)


def situation_series(rows: Rows) -> tuple[list[str], list[plots.Series]]:
    """Rows "SITUATION: METHOD" as situations, and a series for each method over them."""
    split = [(*r["what"].split(": ", 1), r["s"]) for r in rows]
    situations = list(dict.fromkeys(where for where, _, _ in split))
    methods = dict.fromkeys(method for _, method, _ in split)
    own = {m: [(situations.index(where), s) for where, method, s in split if method == m] for m in methods}
    return situations, [plots.Series(m, *zip(*values, strict=True)) for m, values in own.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, comma-separated")
    parser.add_argument("--data", type=Path, help="a folder of point clouds, in place of those made here")
    parser.add_argument("--points", type=int, default=12_288, help="of a cloud made here, at most of a file")
    parser.add_argument("--clouds", type=int, default=5, help="how many rooms to make")
    parser.add_argument("--repeats", type=int, default=7, help="of each run")
    parser.add_argument("--pairs", type=int, default=200, help="of `fmr batch`")
    parser.add_argument("--las-points", type=int, default=20_000_000, help="of each of the two LAS files")
    parser.add_argument("--voxel-size", type=float, default=0.05, help="the peers', in the clouds' unit")
    parser.add_argument("--seed", type=int, default=50_000)
    parser.add_argument("--out", type=Path, help="write OUT.json and OUT.png")
    parser.add_argument("--quick", action="store_true", help="2 clouds, 2 repeats, 10 pairs, small files")
    args = parser.parse_args()
    if args.quick:
        args.clouds, args.repeats, args.pairs, args.las_points = 2, 2, 10, 500_000
    clouds = (
        folder_clouds(args.data, args.points, args.seed)[: args.clouds]
        if args.data
        else room_clouds(args.clouds, args.points, args.seed)
    )
    sizes = [1_000, 10_000, 100_000] + ([] if args.quick else [1_000_000])
    setup = Setup(clouds, args.voxel_size, args.repeats, args.pairs, args.las_points, sizes, args.seed)
    console.print(f"{CORES} cores, {platform.processor() or platform.machine()}, Python {platform.python_version()}")
    report = {}
    for part in args.only.split(","):
        report[part] = PARTS[part](setup)
        show(f"{part}: {(PARTS[part].__doc__ or '').splitlines()[0]}", report[part])
    save(args.out, {"cores": CORES, **report}, lambda figure: plot(figure, report), 4.2)


if __name__ == "__main__":
    main()
