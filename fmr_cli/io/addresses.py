"""Files elsewhere: s3://bucket/a.laz, https://host/a.ply, whatever fsspec knows. A copy on this machine is read.

A `Path` folds the slashes, s3:/bucket/a.laz, and is taken for the same address.
"""

from __future__ import annotations

import atexit
import re
import shutil
import threading
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from tempfile import mkdtemp

from fmr_cli.cores import usable_cores
from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import reason

SCHEME = re.compile(r"([a-z][a-z0-9+.-]+):/+")  # of two letters or more: C:/ is a drive
COPIES = 2 * usable_cores() + 2  # that a process keeps: of the pairs that its threads work on, and the next one's

_lock = threading.Lock()
_copies: OrderedDict[str, Path] = OrderedDict()


def address_of(path: str | Path) -> str | None:
    """The address that a path stands for, or None where it is one of this machine."""
    text = str(path)
    found = SCHEME.match(text)
    if found is None or Path(text).exists():
        return None
    slashes = "///" if found[1] == "file" else "//"
    return f"{found[1]}:{slashes}{text[found.end() :]}"


def shown(path: str | Path) -> str:
    """What a path is called in messages."""
    return address_of(path) or str(path)


def located(folder: Path, text: str) -> Path:
    """A path that a file in ``folder`` names: an address as it is."""
    return Path(text) if address_of(text) else folder / text


def local(path: Path) -> Path:
    """The path, or of an address the path of a copy, which is there until some more files have been asked for.

    Raises CloudFileError where fsspec, or its library for this kind of address, is missing, and where it fails.
    """
    address = address_of(path)
    if address is None:
        return path
    with _lock:
        if address not in _copies:
            _copies[address] = fetched(address)
            while len(_copies) > COPIES:
                shutil.rmtree(_copies.popitem(last=False)[1].parent, ignore_errors=True)
        _copies.move_to_end(address)
        return _copies[address]


def fetched(address: str) -> Path:
    try:
        import fsspec
    except ImportError:
        raise CloudFileError("needs the library fsspec: pip install fsspec, or 'fmr-cli[dask]'") from None
    folder = Path(mkdtemp(prefix="fmr-"))
    copy = folder / (address.rstrip("/").rsplit("/", 1)[1] or "file")
    try:
        with fsspec.open(address, "rb") as there, copy.open("wb") as here:
            shutil.copyfileobj(there, here, 1 << 22)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, FileNotFoundError):
            raise CloudFileError("no such file, check the address") from error
        if isinstance(error, Exception):
            raise CloudFileError(f"cannot be fetched ({reason(error)})") from error
        raise
    return copy


@atexit.register
def remove_copies() -> None:
    """Of this process."""
    with suppress(RuntimeError):
        for copy in _copies.values():
            shutil.rmtree(copy.parent, ignore_errors=True)
    _copies.clear()
