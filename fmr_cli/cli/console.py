"""What every command says to a person, always on stderr: lines, complaints, the log, a sign of life."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from fmr_cli.cloud import PointCloud
    from fmr_cli.io.stream import CloudStream

err = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)

BAD_INPUT, UNCERTAIN, STOPPED = 2, 3, 130  # exit codes; the last one after Ctrl-C, as shells have it


def say(*lines: str, quiet: bool = False) -> None:
    """Lines for a person."""
    for line in () if quiet else lines:
        err.print(line, markup=False)


def warn(*lines: str, quiet: bool = False) -> None:
    say(*(f"warning: {line}" for line in lines), quiet=quiet)


def complain(error: Exception) -> None:
    """The one line that says what is wrong."""
    err.print(f"fmr: {' '.join(str(error).split())}", style="red", markup=False)


class Lines(logging.Handler):
    """Log records as lines, above a progress bar where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        err.print(self.format(record), markup=False, style="dim")


def show_log(verbose: int) -> None:
    """Say what the library logs: at 1 what it decided and why, at 2 also details, with the module and the seconds."""
    log = logging.getLogger("fmr_cli")
    log.handlers = [Lines()] if verbose else []
    log.setLevel((logging.NOTSET, logging.INFO, logging.DEBUG)[min(verbose, 2)])
    for handler in log.handlers if verbose > 1 else []:
        handler.setFormatter(logging.Formatter("%(relativeCreated)6.0f ms %(name)s: %(message)s"))


def busy(text: str, quiet: bool) -> AbstractContextManager[object]:
    """A sign of life on a terminal while its block runs."""
    return err.status(text) if err.is_terminal and not quiet else nullcontext()


def progress(quiet: bool, *, counted: bool = True) -> Progress:
    """A progress bar on a terminal; its tasks have a text ``said``. counted: show how many are done and to come."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    left = (MofNCompleteColumn(), TimeRemainingColumn()) if counted else ()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), *left)
    return Progress(*columns, TextColumn("{task.fields[said]}"), console=err, disable=quiet or not err.is_terminal)


@contextmanager
def points_bar(text: str, quiet: bool) -> Iterator[Callable[[CloudStream], CloudStream]]:
    """A bar of the points that are read or written: the stream as the block's function returns it moves it.

    How many there will be is known once the stream has been surveyed, which is done here.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
               TextColumn("{task.fields[said]}"))  # fmt: skip
    with Progress(*columns, console=err, transient=True, disable=quiet or not err.is_terminal) as bar:

        def count(stream: CloudStream) -> CloudStream:
            task = bar.add_task(text, total=None, said="looking at all points")
            counted = stream.map(lambda cloud: moved(task, cloud))
            counted.survey = stream.survey
            bar.update(task, total=counted.survey.count, completed=0)
            return counted

        def moved(task: TaskID, cloud: PointCloud) -> PointCloud:
            bar.advance(task, len(cloud))
            speed = bar.tasks[0].speed
            bar.update(task, said=f"{speed / 1e6:.1f} million points a second" if speed else "")
            return cloud

        yield count


@contextmanager
def quick_imports() -> Iterator[None]:
    """Imports without garbage collection: what they make stays, and looking through it takes a fifth of their time."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()
