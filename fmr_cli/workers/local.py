"""Workers on this machine: this process, or processes beside it, which Python's lock does not hold up."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import Any

from fmr_cli.cores import usable_cores
from fmr_cli.workers.base import AHEAD, Answer, LostError, Task, Workers, forget


def on_this_machine(workers: int | Workers | None, tasks: int) -> Workers:
    """The workers that are given, or so many processes (None: one a core), but not more than there are tasks."""
    if workers is not None and not isinstance(workers, int):
        return workers
    count = min(workers or usable_cores(), tasks)
    return Processes(count) if count > 1 else Here()


class Here:
    """This process, one task after the other."""

    count = 1
    remote = False

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Generator[Answer | LostError, None, None]:
        try:
            yield from map(function, tasks)
        finally:
            forget()


@dataclass
class Handed:
    """A task that is handed out."""

    task: Any
    future: Future[Any] | None = None


class Processes:
    """Processes of this machine. One that dies, as by the system for want of memory, takes no other task with it."""

    remote = False

    def __init__(self, count: int) -> None:
        self.count = count

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Generator[Answer | LostError, None, None]:
        todo, waiting = iter(tasks), deque[Handed]()
        pool = Pool(self.count)
        try:
            while True:
                waiting.extend(map(Handed, islice(todo, AHEAD * self.count - len(waiting))))
                if not waiting:
                    return
                try:
                    for handed in waiting:
                        handed.future = handed.future or pool.submit(function, handed.task)
                    assert waiting[0].future
                    answer = waiting[0].future.result()
                except BrokenProcessPool:  # one process died and its pool with it: nobody knows over which task
                    pool.stop()
                    answer = alone(function, waiting[0].task)
                    pool = Pool(self.count)
                    for handed in waiting:
                        if not done_well(handed.future):
                            handed.future = None
                waiting.popleft()
                yield answer
        finally:
            pool.stop()


def alone(function: Callable[[Task], Answer], task: Task) -> Answer | LostError:
    """The answer of a process that does this task only."""
    pool = Pool(1)
    try:
        return pool.submit(function, task).result()
    except BrokenProcessPool:
        return LostError("the process that worked on it died twice, as for want of memory; give it fewer points")
    finally:
        pool.stop()


def done_well(future: Future[Any] | None) -> bool:
    return future is not None and future.done() and not isinstance(future.exception(), BrokenProcessPool)


class Pool(ProcessPoolExecutor):
    """A pool whose processes can be stopped at once, and end with this process whatever ends it."""

    def __init__(self, count: int) -> None:
        self.context = Context()
        super().__init__(count, self.context, initializer=begin)

    def stop(self) -> None:
        for process in self.context.started:
            process.terminate()
        self.shutdown(cancel_futures=True)


class Process(SpawnProcess):
    """A process that does not run the user's script again, as multiprocessing's own do: no task comes from there."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802 (multiprocessing's name)
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            return SpawnProcess._Popen(process_obj)
        finally:
            sys.modules["__main__"] = main


class Context(SpawnContext):
    """Starts new processes (a fork of one that has threads may hang) and remembers them."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[Process] = []

    def Process(self, *args: Any, **kwargs: Any) -> Process:  # type: ignore[override]  # noqa: N802
        self.started.append(Process(*args, **kwargs))
        return self.started[-1]


def begin() -> None:
    """First in every worker process: Ctrl-C ends it without a word, and so does the end of the process it works for."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported

    def end_with_parent() -> None:
        parent = parent_process()
        if parent:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
