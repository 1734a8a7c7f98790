"""What a process does with the memory that it frees."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # glibc's malloc.h


@cache
def keep_freed_memory() -> None:
    """Have this process keep freed memory for its next arrays, up to 64 MB, in place of giving it back to the system.

    Every array of a pair or a scan would then be new pages, which take a sixth of the time of making a scan ready, and
    longer than the work on a pair where all is given back at once.
    """
    with suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 32 << 20)  # what glibc itself goes up to
        mallopt(M_TRIM_THRESHOLD, 64 << 20)
