"""A line on a terminal that says how far a sequence is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def live(console: Any, shown: bool) -> Iterator[Callable[[dict[str, Any], int, int], None]]:
    """Yields the function that takes each new row, how many rows there are, and of how many."""
    if not shown:
        yield lambda row, done, total: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    begin, length, seen = time.perf_counter(), 0.0, 0
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("starting", total=None)

        def show(row: dict[str, Any], done: int, total: int) -> None:
            nonlocal length, seen
            length, seen = length + row["motion"], seen + 1
            rate = seen / (time.perf_counter() - begin)
            said = f"{rate:.1f} frames/s, {row['status']}, path {length:.4g}"
            progress.update(task, total=total, completed=done, description=said)

        yield show
