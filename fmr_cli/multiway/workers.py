"""Where the work of a run is handed out: the one place that knows of workers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from typing import TypeVar

from fmr_cli.cores import usable_cores
from fmr_cli.workers import Workers
from fmr_cli.workers.base import LostError

Item = TypeVar("Item")
Result = TypeVar("Result")


def nothing(number: int, result: object) -> None:
    """What is done with a result that nobody waits for."""


class Threads:
    """Threads of this process, and where there are some, workers beyond it (``cluster``), which register the pairs.

    numpy and small_gicp let threads run side by side.
    """

    def __init__(self, workers: int | Workers | None = None) -> None:
        self.cluster = None if workers is None or isinstance(workers, int) else workers
        self.pool = ThreadPoolExecutor(workers if isinstance(workers, int) else usable_cores())

    def map(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        arrived: Callable[[int, Result], None] = nothing,
    ) -> list[Result]:
        """The results in the items' order; ``arrived`` is called, in this thread, with each one's number as it comes.

        Raises what ``function`` raises.
        """
        futures = {self.pool.submit(function, item): number for number, item in enumerate(items)}
        for future in as_completed(futures):
            arrived(futures[future], future.result())
        return [future.result() for future in futures]

    def hand_out(
        self,
        function: Callable[[Item], Result],
        tasks: Sequence[Item],
        arrived: Callable[[int, Result | LostError], None] = nothing,
    ) -> list[Result | LostError]:
        """As ``map``, by the cluster: function and tasks are small, and are pickled."""
        assert self.cluster
        results = []
        with closing(self.cluster.run(function, tasks)) as answers:
            for number, answer in enumerate(answers):
                arrived(number, answer)
                results.append(answer)
        return results

    def close(self) -> None:
        """Ends the workers; what has not begun is not done any more."""
        self.pool.shutdown(cancel_futures=True)
