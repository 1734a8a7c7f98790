"""Functions that the tests hand to workers: of a module, so that any process can import them."""

from __future__ import annotations

import os
import signal
import time

from fmr_cli.errors import FmrError
from fmr_cli.workers.base import UnfitError, kept


def square(number: int) -> int:
    return number * number


def later(number: int) -> int:
    """The first tasks take longest."""
    time.sleep(0.05 * max(0, 4 - number))
    return number


def process_of(number: int) -> int:
    time.sleep(0.01)
    return os.getpid()


def dies_of_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def complains_of_three(number: int) -> int:
    if number == 3:
        raise FmrError("three is too much")
    return number


def so_far(number: int) -> int:
    """How many tasks this process has done."""
    done = kept("done", list)
    done.append(number)
    return len(done)


def with_file(path: str) -> int:
    if not os.path.exists(path):
        raise UnfitError(f"{path} is not there")
    return os.getpid()


def slow(number: int) -> int:
    time.sleep(0.03)
    return number
