"""Where the work of a run is handed out: the one place that knows of workers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

from fmr_cli.cores import usable_cores

Item = TypeVar("Item")
Result = TypeVar("Result")


def nothing(number: int, result: object) -> None:
    """What is done with a result that nobody waits for."""


class Workers:
    """Threads of this process; numpy and small_gicp let them run side by side.

    Whatever takes its place (other machines) needs ``map`` and ``close`` alone. Pairs that are registered go through
    ``map`` as picklable tasks with a picklable function (``registering.register``).
    """

    def __init__(self, count: int | None = None) -> None:
        self.pool = ThreadPoolExecutor(count or usable_cores())

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

    def close(self) -> None:
        """Ends the workers; what has not begun is not done any more."""
        self.pool.shutdown(cancel_futures=True)
