"""How tasks are handed to the workers of a Dask scheduler and answers come back in order, whatever happens to some."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any

from fmr_cli.errors import FmrError
from fmr_cli.workers.base import AHEAD, LostError, UnfitError
from fmr_cli.workers.memory import keep_freed_memory

if TYPE_CHECKING:
    from fmr_cli.workers.cluster import DaskWorkers

PER_THREAD = 2  # tasks a thread of a worker is given at a time: the next one is there when it ends one
FETCH = 20.0  # s that a worker has to hand over an answer that is ready
TICK = 0.5  # s after which workers are looked at although no answer has come
# A task is late when it takes longer than so many seconds and so many times as long as the slowest one so far.
PATIENCE, SLOWER = 30.0, 4.0
COPIES = 3  # of a late task, at most; and of tries of one that a worker cannot run


@dataclass
class Handed:
    """A task that is handed out. copies: by key, each future and the workers that it may run on."""

    task: Any
    since: float = 0.0
    copies: dict[str, tuple[Any, set[str]]] = field(default_factory=dict)
    failures: int = 0  # that came back
    suspect: bool = False  # its workers are gone, maybe for its sake: it is tried once more,
    alone: bool = False  # while nothing else is
    answered: bool = False
    answer: Any = None

    def take(self, answer: Any) -> None:
        """The first answer counts."""
        self.answered, self.answer = True, answer
        for future, _ in self.copies.values():
            future.release()
        self.copies.clear()


@dataclass
class Came:
    """What comes back from a worker: an answer, or what the function raised."""

    worker: str
    answer: Any = None
    error: Exception | None = None


class Handing:
    """One run of a function over tasks."""

    def __init__(
        self, workers: DaskWorkers, function: Callable[[Any], Any], tasks: Iterable[Any], fetchers: ThreadPoolExecutor
    ) -> None:
        self.workers, self.function, self.fetchers = workers, function, fetchers
        self.todo, self.more = iter(tasks), True
        self.waiting: deque[Handed] = deque()  # whose answers have not been given yet, in order
        self.arrived: queue.SimpleQueue[tuple[Handed, str, Any]] = queue.SimpleQueue()
        self.slowest = 0.0  # s, of the answers so far

    def answers(self) -> Generator[Any, None, None]:
        """The answers in the tasks' order. Raises FmrError as ``DaskWorkers.look_at_workers``; what a task raised."""
        try:
            while True:
                if there := self.workers.look_at_workers():
                    self._hand_out_again(there)
                    self._hand_out_more()
                while self.waiting and self.waiting[0].answered:
                    yield self.waiting.popleft().answer
                if not self.waiting and not self.more:
                    return
                self._chase_late_ones()
                for handed, key, back in self._arrivals():
                    self._take(handed, key, back)
        finally:
            self.workers.give_up([future for handed in self.waiting for future, _ in handed.copies.values()])

    def _unanswered(self) -> list[Handed]:
        return [handed for handed in self.waiting if not handed.answered]

    def _hand_out(self, handed: Handed, to: set[str]) -> None:
        future = self.workers.submit(call, (self.function, handed.task), to)
        handed.since = time.monotonic()
        handed.copies[future.key] = future, to
        future.add_done_callback(lambda done: self.fetchers.submit(self._fetch, handed, done))

    def _hand_out_again(self, there: set[str]) -> None:
        """What has no copy any more on a worker that is there: they are gone, or the connection was lost."""
        for handed in self._unanswered():
            for key in [key for key, (_, allowed) in handed.copies.items() if not allowed & there]:
                handed.copies.pop(key)[0].release()
                handed.suspect = True
            if not handed.copies and not handed.suspect:
                self._hand_out(handed, self.workers.responsive())
        suspects = self._suspects()
        if suspects and not any(handed.copies for handed in self.waiting):
            if suspects[0].alone:
                return suspects[0].take(
                    LostError("several workers died over it, as for want of memory; give it fewer points")
                )
            suspects[0].alone = True
            self._hand_out(suspects[0], {min(self.workers.responsive())})

    def _suspects(self) -> list[Handed]:
        return [handed for handed in self._unanswered() if handed.suspect]

    def _hand_out_more(self) -> None:
        count = self.workers.count
        room = min(AHEAD * count - len(self.waiting), PER_THREAD * count - len(self._unanswered()))
        if self.more and room > 0 and not self._suspects():
            new = [Handed(task) for task in islice(self.todo, room)]
            self.more = len(new) == room
            self.waiting += new
            for handed in new:
                self._hand_out(handed, self.workers.responsive())

    def _chase_late_ones(self) -> None:
        """Gives late tasks to others too, and no more tasks to the workers that are late."""
        now, workers = time.monotonic(), self.workers
        late = [h for h in self._unanswered() if now - h.since > max(PATIENCE, SLOWER * self.slowest) and h.copies]
        if not late or not self.slowest:
            return
        holders = workers.holders()
        for worker in {holders[key] for h in late for key in h.copies if key in holders} - workers.silent:
            workers.silent.add(worker)
            workers.say(f"worker {worker} has been silent for {now - late[0].since:.0f} s: others do its tasks")
        free = set(workers.fit) - workers.silent
        for handed in late:
            if free and len(handed.copies) < COPIES:
                self._hand_out(handed, free)

    def _fetch(self, handed: Handed, future: Any) -> None:
        """In a thread: the result, or the exception in its place."""
        try:
            back = future.result(timeout=FETCH)
        except BaseException as error:
            back = error
        self.arrived.put((handed, future.key, back))

    def _arrivals(self) -> Iterator[tuple[Handed, str, Any]]:
        """All that has come back; waits a TICK for the first."""
        with suppress(queue.Empty):
            yield self.arrived.get(timeout=TICK)
            while True:
                yield self.arrived.get_nowait()

    def _take(self, handed: Handed, key: str, back: Any) -> None:
        """Takes an answer, or leaves the task without this copy, so that it is handed out again."""
        from distributed import KilledWorker

        if handed.copies.pop(key, None) is None:
            return  # given up before
        if isinstance(back, Came):
            self.workers.silent.discard(back.worker)
            if isinstance(back.error, UnfitError):
                if back.worker in self.workers.fit:
                    self.workers.refuse(back.worker, f"cannot do it: {back.error}")
                handed.alone = False
                return
            if back.error is not None:
                raise back.error
            self.slowest = max(self.slowest, time.monotonic() - handed.since)
            handed.take(back.answer)
        elif isinstance(back, KilledWorker):  # by this task or by one that the worker had as well
            handed.suspect = True
        elif isinstance(back, CancelledError | TimeoutError | OSError):  # the way there or back is broken, not the task
            handed.alone = False
        else:
            handed.failures += 1
            if handed.failures == COPIES:
                what = f"{type(back).__name__}: {back}"
                raise FmrError(f"--dask {self.workers.name}: a task cannot be run there ({what})")


def call(work: tuple[Callable[[Any], Any], Any]) -> Came:
    """On the worker: a function and its task."""
    from distributed import get_worker

    keep_freed_memory()  # Dask's nanny has asked for all of it to be given back at once (trim at 64 kB)
    function, task = work
    worker = get_worker().address
    try:
        return Came(worker, function(task))
    except Exception as error:
        return Came(worker, error=error)
