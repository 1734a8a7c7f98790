"""Who reads scans ahead of the registration: a thread, and where that gains time a process."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from fmr_cli.cloud import PointCloud
from fmr_cli.cores import usable_cores
from fmr_cli.sequence.scans import Scans
from fmr_cli.workers.local import Pool
from fmr_cli.workers.memory import keep_freed_memory

# Scans, from which a process is worth its start, which takes half a second of a core that else lies idle.
WORTH_A_PROCESS = 16

Done = TypeVar("Done")


def worth_a_process(scans: Scans, count: int, *, keep_clouds: bool) -> bool:
    """Whether so many of the scans are enough for a process; its answers must be small, and so must what it is told."""
    if count < WORTH_A_PROCESS or usable_cores() == 1 or keep_clouds:
        return False
    return not any(isinstance(source, PointCloud) for source in scans.sources)


class Readers:
    """A thread that works while this one registers, and a process where asked for (small_gicp keeps Python's lock).

    A context: it ends both. Who does a task changes no bit of it. The process starts at once, so that it is there when
    the first task is.
    """

    def __init__(self, apart: bool) -> None:
        self.thread = ThreadPoolExecutor(1)
        self.process = Pool(1) if apart else None
        self.started = self.process.submit(start) if self.process else None

    def __enter__(self) -> Readers:
        return self

    def __exit__(self, *_: object) -> None:
        self.thread.shutdown(cancel_futures=True)
        self.without_process()

    def without_process(self) -> None:
        """From here on the thread does all of it."""
        if self.process:
            self.process.stop()
        self.process = self.started = None

    def hand_out(self, task: Callable[..., Done], *given: Any) -> Callable[[], Done]:
        """Have a task done; returns what waits for it. Until the process has started, the thread does it."""
        if self.process and self.started and self.started.done():
            with suppress(BrokenExecutor):
                future = self.process.submit(task, *given)
                return partial(from_process, future, task, *given)
        return self.thread.submit(task, *given).result


def from_process(future: Future[Done], task: Callable[..., Done], *given: Any) -> Done:
    try:
        return future.result()
    except BrokenExecutor:  # it was killed, as for want of memory
        return task(*given)


def start() -> None:
    """The first task of a process: when it is done, Python and what is imported with the sequences are there."""
    import fmr_cli.sequence.loader  # noqa: F401

    keep_freed_memory()
