"""Many pairs: throughput by workers, what a Dask scheduler costs a pair, and what a million pairs would take.

    python -m benchmarks.scale workers     # pairs of 12,000 points, in turn by 1, 2, 4 processes and Dask workers
    python -m benchmarks.scale scheduler   # 100, 1,000, 10,000 tasks that carry the messages of a pair, and do nothing
    python -m benchmarks.scale pairs       # 100, 1,000, 10,000 real pairs of small clouds by Dask, and by processes
    python -m benchmarks.scale paper       # a million pairs on 1,000 cores, from the figures that the others left

Figures go to --out (scale.json), which each run adds to. Pairs are halves of made-up rooms that share 80 %. Seconds of
starting are not in the pairs a second: these count from the first row to the last. ``cpu`` is the processor's seconds a
pair, which other jobs on the machine disturb less.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.common import make_pair, room_clouds, show
from fmr_cli import PointCloud, align, write_cloud
from fmr_cli.batch import align_batch
from fmr_cli.batch.cache import CloudCache
from fmr_cli.batch.manifest import Pair, read_manifest
from fmr_cli.batch.one_pair import Block, Done, PairRunner
from fmr_cli.batch.results import ResultsTable
from fmr_cli.io import write_transform
from fmr_cli.io.outputs import write_json
from fmr_cli.registration import Options
from fmr_cli.workers import DaskWorkers

MILLION, CORES = 1_000_000, 1_000


def room_pairs(count: int, points: int) -> list[tuple[PointCloud, PointCloud]]:
    """So many pairs of ``points`` points each, each of another room."""
    pairs = []
    for number, cloud in enumerate(room_clouds(count, 5 * points // 2, 0)):
        source, target, _ = make_pair("overlap80", cloud, np.random.default_rng((1, number)))
        pairs.append((PointCloud(source[:points]), PointCloud(target[:points])))
    return pairs


def quickest(pairs: list[tuple[PointCloud, PointCloud]], count: int) -> list[tuple[PointCloud, PointCloud]]:
    """So many of the pairs, those that ``align`` needs the least of the processor for: its first look is sure."""
    seconds = []
    for pair in pairs:
        begin = time.process_time()
        align(*pair, threads=1)
        seconds.append(time.process_time() - begin)
    return [pairs[n] for n in np.argsort(seconds)[:count]]


def write_pairs(folder: Path, count: int, pairs: list[tuple[PointCloud, PointCloud]]) -> Path:
    """A manifest of so many pairs, every file read once: of these pairs, and of links to them under other names."""
    for number in range(count):
        for side, name in enumerate("st"):
            path = folder / f"{number}_{name}.ply"
            if number < len(pairs):
                write_cloud(path, pairs[number][side])
            else:
                os.link(folder / f"{number % len(pairs)}_{name}.ply", path)
    path = folder / "pairs.csv"
    path.write_text("source,target\n" + "".join(f"{number}_s.ply,{number}_t.ply\n" for number in range(count)))
    return path


def first_of(manifest: Path, count: int) -> Path:
    """A manifest beside this one with its first ``count`` pairs."""
    path = manifest.with_name(f"first_{count}.csv")
    path.write_text("".join(manifest.read_text().splitlines(keepends=True)[: count + 1]))
    return path


class EnoughError(Exception):
    """The minutes that a run may take are over."""


def throughput(manifest: Path, workers: int, dask: bool, minutes: float = np.inf) -> dict[str, Any]:
    """One run of a batch: its pairs a second from the first row to the last, seconds in all, CPU seconds a pair.

    minutes: after which it is cut off, as by Ctrl-C. cpu ms at this end: of the processor, what the command's process
    takes a pair: it hands out and writes; with Dask it is the scheduler too. bytes a pair: over this machine's
    loopback, which other programs may use as well.
    """
    told: list[float] = []

    def on_row(row: dict[str, Any], done: int, total: int) -> None:
        assert row["status"] != "failed", row["message"]
        told.append(time.perf_counter())
        if told[-1] - begin > 60 * minutes:
            raise EnoughError

    with tempfile.TemporaryDirectory() as out, ExitStack() as stack:
        begin, before, here, sent = time.perf_counter(), cpu_seconds(), time.process_time(), loopback()
        team = stack.enter_context(DaskWorkers("local", workers, lambda _: None)) if dask else workers
        with suppress(EnoughError):
            align_batch(manifest, Path(out) / "out", workers=team, on_row=on_row)
        took, cpu = time.perf_counter() - begin, cpu_seconds() - before
        here, sent = time.process_time() - here, loopback() - sent
    count = len(told)
    return {"by": f"{workers} {'Dask workers' if dask else 'processes'}", "pairs": len(read_manifest(manifest)),
            "done": count, "pairs/s": (count - 1) / (told[-1] - told[0]), "s in all": took, "cpu s a pair": cpu / count,
            "cpu ms at this end": 1000 * here / count, "bytes a pair": sent / count if dask else None}  # fmt: skip


def in_turn(manifest: Path, workers: list[int], repeat: int) -> list[dict[str, Any]]:
    """All ways one after the other, ``repeat`` times, so that what else the machine does meets all alike.

    Of each the median throughput and the least CPU seconds a pair.
    """
    ways = [(n, dask) for n in workers for dask in (False, True)]
    runs = [[throughput(manifest, *way) for way in ways] for _ in range(repeat)]
    rows = []
    for same in zip(*runs, strict=True):
        middle = sorted(same, key=lambda row: row["pairs/s"])[len(same) // 2]
        rows.append(middle | {"cpu s a pair": min(row["cpu s a pair"] for row in same)})
    return rows


def compared(rows: list[dict[str, Any]]) -> list[str]:
    """The two ratios that the documentation speaks of, by the clock and by the processor."""
    by = {row["by"]: row for row in rows}
    said = []
    for a, b, what in (
        ("2 Dask workers", "2 processes", "two Dask workers to two processes"),
        ("2 processes", "1 processes", "two processes to one"),
        ("2 Dask workers", "1 Dask workers", "two Dask workers to one"),
    ):
        if a in by and b in by:
            rate, cpu = (by[a][key] / by[b][key] for key in ("pairs/s", "cpu s a pair"))
            said.append(f"{what}: throughput x {rate:.2f}, CPU seconds a pair x {cpu:.2f}")
    return said


def cpu_seconds() -> float:
    """Of the processor, by this process and all below it, those that have ended too."""
    total = 0.0
    for process in [psutil.Process(), *psutil.Process().children(recursive=True)]:
        try:
            times = process.cpu_times()
        except psutil.Error:
            continue
        total += times.user + times.system
        if process.pid == psutil.Process().pid:
            total += times.children_user + times.children_system
    return total


class Answering:
    """In the place of ``PairRunner``: takes its messages and gives its answer, without the work between."""

    def __init__(self, runner: PairRunner, done: Done) -> None:
        self.runner, self.done = runner, done

    def do(self, block: Block) -> list[Done]:
        return [self.done for _ in block.pairs]


def one_done(folder: Path, manifest: Path) -> tuple[PairRunner, Pair, Done]:
    runner = PairRunner(folder, folder / "out", Options(), False, False, 10_000)
    pair = read_manifest(manifest)[0]
    return runner, pair, runner.one(pair, CloudCache())


def scheduler_cost(tasks: int, runner: PairRunner, pair: Pair, done: Done, workers: int = 2) -> dict[str, Any]:
    """What a pair costs besides its work: ms of the scheduler, bytes over the network (this machine's loopback)."""
    answering = Answering(runner, done)
    blocks = [Block((pair,), frozenset(runner.files(pair)), runner.files(pair)) for _ in range(tasks)]
    with DaskWorkers("local", workers, lambda _: None) as team:
        list(team.run(answering.do, blocks[:20]))
        before, begin, cpu = loopback(), time.perf_counter(), time.process_time()
        assert sum(1 for _ in team.run(answering.do, blocks)) == tasks
        seconds, moved = time.perf_counter() - begin, loopback() - before
        cpu = time.process_time() - cpu  # of client and scheduler, which are in this process
    sizes = {name: len(pickle.dumps(x)) for name, x in (("task", (runner, blocks[0])), ("answer", [done]))}
    return {"tasks": tasks, "ms a task": 1000 * seconds / tasks, "cpu ms a task": 1000 * cpu / tasks,
            "bytes a task": moved / tasks, **sizes}  # fmt: skip


def loopback() -> int:
    return psutil.net_io_counters(pernic=True)["lo"].bytes_sent


def writing_cost(folder: Path, pair: Pair, done: Done, count: int = 200) -> dict[str, Any]:
    """What this end does for each row: transform, metrics, the row on the disk."""
    assert done.T_target_source is not None
    with ResultsTable(folder / "written", {}) as table:
        table.open([pair], False)
        begin, cpu = time.perf_counter(), time.process_time()
        for number in range(count):
            write_transform(folder / f"{number}.txt", done.T_target_source)
            write_json(folder / f"{number}.json", done.metrics)
            table.add(done.row)
        seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    written = sum((folder / f"0.{kind}").stat().st_size for kind in ("txt", "json"))
    return {"ms a row": 1000 * seconds / count, "cpu ms a row": 1000 * cpu / count, "bytes a row": written}


def on_paper(found: dict[str, Any]) -> list[dict[str, Any]]:
    """A million pairs on 1,000 cores: how long each part takes, if it had the whole time to itself."""
    if missing := {"workers", "scheduler"} - set(found):
        raise SystemExit(f"first: python -m benchmarks.scale {' and '.join(sorted(missing))}")
    pair = min(row["cpu s a pair"] for row in found["workers"])
    task = found["scheduler"][-1]
    row = found["writing"]
    parts = {
        "registering, minutes on 1,000 cores": MILLION * pair / CORES / 60,
        "scheduler and client, minutes of one core": MILLION * task["cpu ms a task"] / 1000 / 60,
        "transforms, metrics and rows, minutes of one process": MILLION * row["ms a row"] / 1000 / 60,
        "over the scheduler's network, GB": MILLION * task["bytes a task"] / 1e9,
        "transforms and metrics, GB": MILLION * row["bytes a row"] / 1e9,
        "cores that one scheduler and client keep busy": pair / (task["cpu ms a task"] / 1000),
    }
    return [{"what": name, "figure": figure} for name, figure in parts.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["workers", "scheduler", "pairs", "paper"])
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--points", type=int, default=12_000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--tasks", type=int, nargs="+", default=[100, 1_000, 10_000])
    parser.add_argument("--counts", type=int, nargs="+", default=[100, 1_000, 10_000])
    parser.add_argument("--small", type=int, default=1_000, help="points of a cloud of ``pairs``")
    parser.add_argument("--minutes", type=float, default=np.inf, help="of ``pairs``, after which a run is cut off")
    parser.add_argument("--both", type=int, default=1_000, help="pairs from which on Dask alone does them")
    parser.add_argument("--out", type=Path, default=Path("scale.json"))
    given = parser.parse_args()
    found: dict[str, Any] = json.loads(given.out.read_text()) if given.out.exists() else {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        if given.what == "workers":
            manifest = write_pairs(folder, given.pairs, room_pairs(given.pairs, given.points))
            found["workers"] = in_turn(manifest, given.workers, given.repeat)
            show(f"{given.pairs} pairs of {given.points} points, {given.repeat} times", found["workers"])
            for line in compared(found["workers"]):
                print(line)
        elif given.what == "pairs":
            manifest = write_pairs(folder, max(given.counts), quickest(room_pairs(24, given.small), 4))
            done = {(row["by"], row["pairs"]): row for row in found.get("pairs", [])}  # the last of each stays
            for count in given.counts:
                for dask in (True, False) if count <= given.both else (True,):
                    row = throughput(first_of(manifest, count), 2, dask, given.minutes)
                    done[row["by"], count] = row | {"points": given.small}
                    found["pairs"] = list(done.values())
                    write_json(given.out, found)  # the larger ones take long
            show(f"pairs of {given.small} points", found["pairs"])
        elif given.what == "scheduler":
            runner, pair, done = one_done(folder, write_pairs(folder, 1, room_pairs(1, given.points)))
            found["scheduler"] = [scheduler_cost(n, runner, pair, done) for n in given.tasks]
            found["writing"] = writing_cost(folder, pair, done)
            show("tasks that carry a pair's messages, two workers", found["scheduler"])
            show("rows, transforms, metrics", [found["writing"]])
        else:
            show("a million pairs", on_paper(found))
    write_json(given.out, found)


if __name__ == "__main__":
    main()
