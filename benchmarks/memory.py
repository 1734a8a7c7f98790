"""Peak memory and seconds of each command on LAS files of many points, each as a process of its own.

    python -m benchmarks.memory --points 6000000 60000000 --out benchmarks/memory.json

The files are made up: a hilly town, sampled twice, the second time turned and shifted. They take 60 bytes a point of
the disk while it runs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
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


def measured(*arguments: object) -> dict[str, float]:
    """Seconds and peak resident memory in MiB of one `fmr` command."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "fmr_cli.cli", *map(str, arguments)], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes
    return {
        "seconds": round(time.perf_counter() - start, 2), "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_mib": round(usage.ru_maxrss * unit / 2**20, 1), "exit": process.returncode,
    }  # fmt: skip


def measure(folder: Path, points: int) -> dict[str, dict[str, float]]:
    """All commands on two files of ``points``, which are made and removed."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    T[:3, 3] = [512_000.0, 5_400_000.0, 300.0]
    a, b, out, pose = folder / "a.las", folder / "b.las", folder / "out.las", folder / "T.txt"
    write_cloud(a, town(points, 1, T))
    write_cloud(b, town(points, 2, np.eye(4)))
    found = {}
    for name, command in {
        "info": ("info", a),
        "align": ("align", a, b, "-o", pose),
        "transform": ("transform", a, pose, "-o", out),
        "align --aligned": ("align", a, b, "-o", pose, "--aligned", out),
        "align --merged": ("align", a, b, "-o", pose, "--merged", out),
    }.items():
        found[name] = measured(*command)
        print(f"{points:>12,} {name:<16} {found[name]}", flush=True)
        if name == "align" and found[name]["exit"] not in (0, 3):
            write_transform(pose, np.linalg.inv(T))
        out.unlink(missing_ok=True)
    a.unlink()
    b.unlink()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--points", type=int, nargs="+", default=[6_000_000, 60_000_000])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {str(points): measure(Path(folder), points) for points in given.points}
    if given.out:
        given.out.write_text(json.dumps({"version": __version__, "cores": os.cpu_count(), **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
