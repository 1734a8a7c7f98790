"""The way of a batch: pairs in; a row each in results.csv out, in the manifest's order, however many work on them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import fmr_cli
from fmr_cli.batch.cache import CloudCache
from fmr_cli.batch.manifest import Pair, read_manifest
from fmr_cli.batch.one_pair import PairRunner
from fmr_cli.batch.results import ResultsTable
from fmr_cli.cores import usable_cores
from fmr_cli.registration import Options
from fmr_cli.registration.result import plain

# Pairs a worker may be ahead of the row that is written next: enough that none waits for a slow pair, and few enough
# that a kill loses little.
AHEAD = 8

OnRow = Callable[[dict[str, Any], int, int], None]


def align_batch(
    manifest: Path, out: Path, options: Options = Options(), *, aligned: bool = False, merged: bool = False,
    resume: bool = False, workers: int | None = None, on_row: OnRow | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Register the pairs of a manifest; returns a row each, in its order, as they are in ``out``/results.csv.

    out: the folder for results.csv, transforms/, and where asked for aligned/ (each moved source) and merged/ (both
    clouds). resume: go on after a kill; rows that are there stay. workers: pairs at a time, or None: one a core; the
    results do not depend on it. on_row: called with each new row once it is on disk, how many rows there are now, and
    of how many.
    Raises CloudFileError where the manifest is not one, or ``out`` holds results of something else; ModelError. What
    is wrong with one pair is a row with the status "failed".
    """
    pairs = read_manifest(manifest)
    settings = plain({"fmr": fmr_cli.__version__, "aligned": aligned, "merged": merged, **vars(options)})
    with ResultsTable(out, settings) as table:
        rows: list[dict[str, Any]] = [*table.open(pairs, resume)]
        todo = pairs[len(rows) :]
        for folder in ("transforms", *(["aligned"] if aligned else []), *(["merged"] if merged else [])):
            (out / folder).mkdir(exist_ok=True)
        cache = CloudCache()
        runner = PairRunner(manifest.parent, out, options, cache, aligned, merged)
        cache.expect(file for pair in todo for file in runner.files(pair))
        with closing(in_order(runner.row, todo, workers or usable_cores())) as done:
            for row in done:
                table.add(row)
                rows.append(row)
                if on_row:
                    on_row(row, len(rows), len(pairs))
    return rows


def in_order(
    register: Callable[[Pair], dict[str, Any]], pairs: list[Pair], workers: int
) -> Generator[dict[str, Any], None, None]:
    """Each pair's row, in the pairs' order; so many of them are worked on at a time."""
    pool = ThreadPoolExecutor(workers)
    try:
        todo, waiting = iter(pairs), deque[Future[dict[str, Any]]]()
        while True:
            waiting.extend(pool.submit(register, pair) for pair in islice(todo, AHEAD * workers - len(waiting)))
            if not waiting:
                return
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
