"""What all kinds of workers have in common, and what they keep between two tasks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any, Protocol, TypeVar

from fmr_cli.errors import FmrError

Task = TypeVar("Task")
Answer = TypeVar("Answer")

# Tasks that are handed out, for each that is worked on, before the answer that is given next is there: enough that no
# worker waits for a slow one, and few enough that a kill loses little.
AHEAD = 8


class LostError(FmrError):
    """Every worker that a task was given to has died over it, as for want of memory."""


class UnfitError(Exception):
    """Raised by a task that this worker cannot do though another one might; its text says what is missing here."""


class Workers(Protocol):
    """Something that works on many tasks at a time.

    count: how many. remote: whether the workers may run on other machines, with other files and other versions.
    """

    count: int
    remote: bool

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Generator[Answer | LostError, None, None]:
        """The answers of ``function`` to the tasks, in their order, whoever is done first.

        function: of a module, or a method of a small object; what it keeps between tasks belongs into ``kept``. A task
        is taken from ``tasks`` when it is handed out. A task that kills its workers has a LostError for an answer;
        what the function raises is raised here. Closing the generator gives up what is under way.
        """
        ...


def check_there(paths: Iterable[Path]) -> None:
    """On a worker: raises UnfitError where it does not see a file that others see."""
    for path in paths:
        if not path.exists():
            raise UnfitError(f"{path} is not there; all workers need the files at the same path")


_kept: dict[str, Any] = {}
_lock = threading.Lock()


def kept(name: str, make: Callable[[], Any]) -> Any:
    """What this worker's process keeps under a name, made at the first call, until its workers are let go of."""
    with _lock:
        if name not in _kept:
            _kept[name] = make()
        return _kept[name]


def forget() -> None:
    """Lets go of all that is kept."""
    with _lock:
        _kept.clear()
