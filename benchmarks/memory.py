"""Peak memory and seconds of each command on LAS files of many points, each as a process of its own.

    python -m benchmarks.memory --points 6000000 60000000 --out benchmarks/memory.json
    python -m benchmarks.memory --peer 6000000 --out benchmarks/memory.json    # beside CloudCompare, on PLY

The files are made up: a hilly town, sampled twice, the second time turned and shifted. They take 90 bytes a point of
the disk while it runs. CloudCompare as Debian has it (2.11) reads no LAS, so that it is compared on PLY; with the true
pose given to both, what is measured is reading, moving, distances and writing. Each run adds to --out, and the table in
docs/formats.md is what is printed at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fmr_cli import __version__
from fmr_cli.cloud import PointCloud
from fmr_cli.io import write_cloud, write_transform
from fmr_cli.io.stream import CHUNK, CloudStream

SIDE = 400.0  # metres of the town
BLOCK = 40.0  # metres from house to house


def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Hills of some metres, and on most blocks a house of its own size."""
    hills = 8 * np.sin(x / 61 + 1) * np.cos(y / 47) + 3 * np.sin(x / 17 - y / 23)
    i, j = np.floor(x / BLOCK).astype(int), np.floor(y / BLOCK).astype(int)
    fate = np.sin(i * 12.9898 + j * 78.233) * 43758.5453
    fate -= np.floor(fate)
    u, v = x / BLOCK - i - 0.5, y / BLOCK - j - 0.5
    inside = (np.abs(u) < 0.15 + 0.25 * fate) & (np.abs(v) < 0.4 - 0.2 * fate)
    return hills + np.where(inside, 4 + 12 * fate, 0)


def town(count: int, seed: int, T: np.ndarray) -> CloudStream:
    """``count`` points of it moved by T (4x4), with the attributes that an airborne scanner gives."""

    def chunks() -> Iterator[PointCloud]:
        for number, start in enumerate(range(0, count, CHUNK)):
            rng = np.random.default_rng((seed, number))
            n = min(CHUNK, count - start)
            x, y = rng.uniform(0, SIDE, (2, n))
            points = np.column_stack([x, y, heights(x, y) + rng.normal(0, 0.02, n)])
            time = 1e8 + (start + np.arange(n)) * 1e-6
            cloud = PointCloud(points, {
                "intensity": rng.integers(0, 60_000, n).astype(np.uint16), "gps_time": time,
                "classification": rng.integers(1, 6, n).astype(np.uint8),
            })  # fmt: skip
            yield cloud.transformed(T)

    return CloudStream(chunks, "a made-up town")


def fmr(*arguments: object) -> list[str]:
    """An `fmr` command."""
    return [sys.executable, "-m", "fmr_cli.cli", *map(str, arguments)]


# Starts a command and says how it went. In a small process of its own: the peak memory of a command is not below that
# of the process it was forked from.
WATCH = """
import json, os, subprocess, sys, time
start = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
seconds, cpu = time.perf_counter() - start, usage.ru_utime + usage.ru_stime
unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes
print(json.dumps({
    "seconds": round(seconds, 2), "cpu_seconds": round(cpu, 2), "peak_mib": round(usage.ru_maxrss * unit / 2**20, 1),
    "exit": os.waitstatus_to_exitcode(status),
}))
"""


def measured(command: list[str]) -> dict[str, float]:
    """Seconds, of the clock and of the processor, and peak resident memory in MiB of one command."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    watch = [sys.executable, "-S", "-c", WATCH, *command]
    return json.loads(subprocess.run(watch, stdout=subprocess.PIPE, env=environment, check=True).stdout)


def measure(folder: Path, points: int) -> dict[str, dict[str, float]]:
    """All commands on two files of ``points``, which are made and removed."""
    T = pose(512_000.0, 5_400_000.0, 300.0)
    a, b, out, found_pose = folder / "a.las", folder / "b.las", folder / "out.las", folder / "T.txt"
    write_cloud(a, town(points, 1, T))
    write_cloud(b, town(points, 2, np.eye(4)))
    found = {}
    for name, command in {
        "info": ("info", a),
        "align": ("align", a, b, "-o", found_pose),
        "transform": ("transform", a, found_pose, "-o", out),
        "align --aligned": ("align", a, b, "-o", found_pose, "--aligned", out),
        "align --merged": ("align", a, b, "-o", found_pose, "--merged", out),
    }.items():
        found[name] = measured(fmr(*command))
        print(f"{points:>12,} {name:<16} {found[name]}", flush=True)
        out.unlink(missing_ok=True)
    a.unlink()
    b.unlink()
    return found


def pose(*shift: float) -> np.ndarray:
    """A turn by 0.7 rad about z, and a shift: (4, 4)."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    T[:3, 3] = shift
    return T


def beside_peer(folder: Path, points: int) -> dict[str, dict[str, float]]:
    """The same work by fmr and by CloudCompare on two PLY files of ``points``, in turn."""
    a, b, out, truth = folder / "a.ply", folder / "b.ply", folder / "out.ply", folder / "T.txt"
    T = pose(30.0, -20.0, 3.0)
    write_cloud(a, town(points, 1, T))
    write_cloud(b, town(points, 2, np.eye(4)))
    write_transform(truth, np.linalg.inv(T))
    peer = ["CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "PLY", "-PLY_EXPORT_FMT", "BINARY_LE"]
    peer += ["-O", str(a), "-APPLY_TRANS", str(truth)]
    save = ["-SAVE_CLOUDS", "FILE", str(out)]
    found = {}
    for name, ours, theirs in (
        ("transform", ("transform", a, truth, "-o", out), save),
        ("merge", ("align", a, b, "--init", truth, "--merged", out), ["-O", str(b), "-MERGE_CLOUDS", *save]),
        ("distances", ("align", a, b, "--init", truth, "--aligned", out),
         ["-O", str(b), "-AUTO_SAVE", "ON", "-C2C_DIST"]),
    ):  # fmt: skip
        for who, command in (("fmr", fmr(*ours)), ("CloudCompare", [*peer, *theirs])):
            found[f"{name}, {who}"] = measured(command)
            print(f"{points:>12,} {name:<10} {who:<12} {found[f'{name}, {who}']}", flush=True)
            for left in {*folder.iterdir()} - {a, b, truth}:
                left.unlink()
    return found


def table(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Markdown: a row a command, of each number of points the seconds and the memory."""
    names = list(dict.fromkeys(name for rows in found.values() for name in rows))
    head = " | ".join(f"{points} points: s, CPU s | MiB" for points in found)
    lines = [f"| | {head} |", "| --- |" + " ---: | ---: |" * len(found)]
    for name in names:
        cells = [
            f"{row['seconds']:.3g}, {row['cpu_seconds']:.3g} | {row['peak_mib']:.0f}" if row else " | "
            for row in (rows.get(name) for rows in found.values())
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="*", default=[])
    parser.add_argument("--peer", type=int, help="Points of each of two PLY files, for fmr and CloudCompare.")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    found = json.loads(given.out.read_text()) if given.out and given.out.exists() else {}
    found |= {"version": __version__, "cores": os.cpu_count()}
    with tempfile.TemporaryDirectory() as folder:
        for points in given.points:
            found.setdefault("las", {})[f"{points:,}"] = measure(Path(folder), points)
        if given.peer:
            if shutil.which("CloudCompare") is None:
                raise SystemExit("--peer needs CloudCompare: apt-get install cloudcompare")
            found.setdefault("ply", {})[f"{given.peer:,}"] = beside_peer(Path(folder), given.peer)
    for kind in ("las", "ply"):
        if kind in found:
            print(table(found[kind]))
    if given.out:
        given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
