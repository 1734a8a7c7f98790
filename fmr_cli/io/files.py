"""What every reader and writer shares: is the file there, and how to write one without leaving half of it."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fmr_cli.errors import CloudFileError


def check_readable(path: Path) -> int:
    """The size of a readable, non-empty file in bytes; CloudFileError otherwise."""
    if path.is_dir():
        raise CloudFileError(f"{path}: is a folder, give a file in it")
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
    except FileNotFoundError:
        raise CloudFileError(f"{path}: no such file, check the name") from None
    except (OSError, ValueError) as error:
        raise CloudFileError(f"{path}: cannot be opened ({reason(error)}), check its permissions") from error
    if size == 0:
        raise CloudFileError(f"{path}: is empty, write or copy it again")
    return size


def check_writable(path: Path) -> None:
    """Raises CloudFileError where the path is a folder, or its folder is missing or cannot be written to."""
    if path.is_dir():
        raise CloudFileError(f"{path}: is a folder, give the name of a file to write")
    folder = path.parent
    if not folder.is_dir():
        raise CloudFileError(f"{path}: the output folder {folder} does not exist, create it first")
    if not os.access(folder, os.W_OK):
        raise CloudFileError(f"{path}: the output folder {folder} is not writable, choose another")


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path beside ``path`` (same suffix); renames it on success, removes it on failure.

    Devices and pipes (``/dev/stdout``) are written to directly. Raises CloudFileError where the folder is missing or
    cannot be written to, and where writing fails.
    """
    path = Path(path)
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    check_writable(path)
    final = path.resolve()  # a symbolic link stays one
    temporary = final.with_name(f".{final.stem[:100]}.{secrets.token_hex(4)}.tmp{final.suffix}")
    try:
        yield temporary
        os.replace(temporary, final)
    except OSError as error:
        raise CloudFileError(f"{path}: cannot be written ({reason(error)})") from error
    finally:
        temporary.unlink(missing_ok=True)


def reason(error: BaseException) -> str:
    """What went wrong, on one line of at most 200 characters."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(text.split())[:200]
