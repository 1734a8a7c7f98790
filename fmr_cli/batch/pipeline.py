"""The way of a batch: pairs in; a row each in results.csv out, in the manifest's order, whoever works on them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmr_cli
from fmr_cli.batch.cache import CACHED_POINTS
from fmr_cli.batch.manifest import Pair, read_manifest
from fmr_cli.batch.one_pair import Block, Done, PairRunner, failed
from fmr_cli.batch.results import ResultsTable
from fmr_cli.io import write_transform
from fmr_cli.io.files import remove_leftovers
from fmr_cli.io.outputs import write_json
from fmr_cli.registration import Options
from fmr_cli.registration.result import plain
from fmr_cli.workers import Workers
from fmr_cli.workers.base import LostError
from fmr_cli.workers.local import on_this_machine

MOST = 8  # pairs of a block, so that a kill loses little
BLOCKS = 4  # for each worker, at least, so that none waits long for the last one
MANY = 100  # pairs for each worker of a cluster, from which pairs that share no file go together too: fewer messages
REMOTE_POINTS = 4_000_000  # that a worker process of a cluster keeps: 0.4 GB, whatever else runs there

OnRow = Callable[[dict[str, Any], int, int], None]


def align_batch(
    manifest: Path, out: Path, options: Options = Options(), *, aligned: bool = False, merged: bool = False,
    resume: bool = False, workers: int | Workers | None = None, on_row: OnRow | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Register the pairs of a manifest; returns a row each, in its order, as they are in ``out``/results.csv.

    out: the folder for results.csv, transforms/, metrics/, and where asked for aligned/ (each moved source) and
    merged/ (both clouds). resume: go on after a kill; rows that are there stay. workers: processes on this machine, or
    None: one a core; or ``fmr_cli.workers.DaskWorkers``, entered; the results do not depend on it. on_row: called with
    each new row once it is on disk, how many rows there are now, and of how many.
    Raises CloudFileError where the manifest is not one, or ``out`` holds results of something else; ModelError;
    FmrError where a cluster is lost. What is wrong with one pair is a row with the status "failed".
    """
    pairs = read_manifest(manifest)
    settings = plain({"fmr": fmr_cli.__version__, "aligned": aligned, "merged": merged, **vars(options)})
    with ResultsTable(out, settings) as table:
        rows: list[dict[str, Any]] = [*table.open(pairs, resume)]
        todo = pairs[len(rows) :]
        folders = ("transforms", "metrics", *(["aligned"] if aligned else []), *(["merged"] if merged else []))
        for folder in folders:
            (out / folder).mkdir(exist_ok=True)
        team = on_this_machine(workers, len(todo))
        points = REMOTE_POINTS if team.remote else CACHED_POINTS // team.count
        runner = PairRunner(manifest.parent.absolute(), out.absolute(), options, aligned, merged, points, team.remote)
        most = min(MOST, 1 + len(todo) // (BLOCKS * team.count))
        with closing(registered(runner, todo, team, most)) as results:
            for pair, done in zip(todo, results, strict=True):
                if done.T_target_source is not None:
                    write_transform(out / "transforms" / f"{pair.name}.txt", done.T_target_source)
                    write_json(out / "metrics" / f"{pair.name}.json", done.metrics)
                table.add(done.row)
                rows.append(done.row)
                if on_row:
                    on_row(done.row, len(rows), len(pairs))
        for folder in folders:  # of workers that were killed, of pairs that others have written since
            remove_leftovers(out / folder)
    return rows


def registered(runner: PairRunner, pairs: list[Pair], team: Workers, most: int) -> Generator[Done, None, None]:
    """What each pair has given, in the pairs' order; so many of them go to a worker at once."""
    blocks = [*in_blocks(runner, pairs, most, sharing=not team.remote or len(pairs) < MANY * team.count)]
    tasks = (seen_from_here(runner, block) for block in blocks) if team.remote else blocks
    with closing(team.run(runner.do, tasks)) as results:
        for block, done in zip(blocks, results, strict=True):
            if not isinstance(done, LostError):
                yield from done
            elif len(block.pairs) == 1:
                yield failed(block.pairs[0], str(done))
            else:  # one of its pairs has killed its workers
                yield from registered(runner, [*block.pairs], team, most=1)


def in_blocks(runner: PairRunner, pairs: list[Pair], most: int, sharing: bool = True) -> Iterator[Block]:
    """Consecutive pairs, at most so many; sharing: each of which shares a file with the one before."""
    last = {file: number for number, pair in enumerate(pairs) for file in runner.files(pair)}
    first = 0
    for end in range(1, len(pairs) + 1):
        joins = end < len(pairs) and {*runner.files(pairs[end])} & {*runner.files(pairs[end - 1])}
        if end < len(pairs) and end - first < most and (joins or not sharing):
            continue
        block = tuple(pairs[first:end])
        yield Block(block, frozenset(f for pair in block for f in runner.files(pair) if last[f] < end))
        first = end


def seen_from_here(runner: PairRunner, block: Block) -> Block:
    """The block with the files that it needs and that are there, seen from this machine."""
    files = [file for pair in block.pairs for file in (*runner.files(pair), runner.folder / pair.init)]
    if runner.aligned or runner.merged:
        files.append(runner.out / "settings.json")
    return replace(block, there=tuple(file for file in dict.fromkeys(files) if file.is_file()))
