"""What every reader and writer shares: is the file there, and how to write one without leaving half of it."""

from __future__ import annotations

import os
import re
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fmr_cli.errors import CloudFileError

TEMPORARY = re.compile(r"\..*\.(?P<host>\w+)-(?P<pid>[0-9]{1,9})-[0-9a-f]{8}\.tmp(\..*)?")  # a temporary's name
DAY = 86_400  # seconds
HEAD = 64  # bytes
# How files of some kinds begin, their suffixes, what they are
MAGIC = (
    (b"ply\n", (".ply",), "a PLY"), (b"ply\r", (".ply",), "a PLY"), (b"# .PCD", (".pcd",), "a PCD"),
    (b"LASF", (".las", ".laz"), "a LAS or LAZ"), (b"ASTM-E57", (".e57",), "an E57"),
    (b"\x93NUMPY", (".npy",), "a NPY"), (b"#ROSBAG", (".bag",), "a bag of ROS 1"),
    (b"SQLite format 3\0", (".db3",), "a bag of ROS 2 (SQLite)"), (b"\x89MCAP", (".mcap",), "an MCAP"),
    (b"PK\x03\x04", (".zip", ".npz"), "a ZIP archive"), (b"\x1f\x8b\x08", (".gz",), "packed by gzip"),
    (b"7z\xbc\xaf\x27\x1c", (".7z",), "a 7z archive"), (b"Rar!\x1a\x07", (".rar",), "a RAR archive"),
    (b"\xfd7zXZ\0", (".xz",), "packed by xz"), (b"\x28\xb5\x2f\xfd", (".zst",), "packed by zstd"),
)  # fmt: skip
PACKERS = (".zip", ".gz", ".7z", ".rar", ".xz", ".zst")
LONGEST_MESSAGE = 550  # characters, but for the file's name


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


def refuse_other_kind(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raises CloudFileError where a file's first bytes say that it is of another kind than ``suffixes``."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    start = head.lstrip(b"\xef\xbb\xbf \r\n\t").lower()
    if start.startswith(b"version https://git-lfs"):
        raise CloudFileError("is a pointer of Git LFS and not the file itself: get it by `git lfs pull`")
    if start.startswith((b"<!doctype html", b"<html")):
        raise CloudFileError("is a web page, as where a download needs a login: download the file again")
    for magic, kinds, what in MAGIC:
        if head.startswith(magic) and not {*kinds} & {*suffixes}:
            do = "unpack it first" if kinds[0] in PACKERS else f"give it the suffix {kinds[0]}"
            raise CloudFileError(f"is {what} by its first bytes: {do}")


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

    Those that a process left behind when it was killed are removed by the next that writes the same file. Devices and
    pipes (``/dev/stdout``) are written to directly. Raises CloudFileError where the folder is missing or cannot be
    written to, and where writing fails.
    """
    path = Path(path)
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    check_writable(path)
    final = path.resolve()  # a symbolic link stays one
    remove_leftovers(final.parent, prefix_of(final))
    temporary = final.with_name(f"{prefix_of(final)}{host()}-{os.getpid()}-{secrets.token_hex(4)}.tmp{final.suffix}")
    try:
        yield temporary
        os.replace(temporary, final)
    except OSError as error:
        raise CloudFileError(f"{path}: cannot be written ({reason(error)})") from error
    finally:
        temporary.unlink(missing_ok=True)


def prefix_of(final: Path) -> str:
    """How the names of a file's temporaries begin."""
    return f".{final.stem[:100]}."


def host() -> str:
    """This machine's name, as far as a file's name may have it."""
    return re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())[:30]


def remove_leftovers(folder: Path, prefix: str = ".") -> None:
    """Removes what processes that are no more have left of writing files there: of this machine's, or a day old.

    prefix: how the names begin, for those of one file (``prefix_of``).
    """
    for name in os.listdir(folder):  # names alone: a folder may hold the results of ten thousand pairs
        found = TEMPORARY.fullmatch(name) if name.startswith(prefix) else None
        if found is None:
            continue
        path = folder / name
        with suppress(OSError):
            here = found["host"] == host() and os.name == "posix"
            dead = here and not is_running(int(found["pid"]))
            if dead or time.time() - path.stat().st_mtime > DAY:
                path.unlink()


def is_running(pid: int) -> bool:
    """Whether there is a process of that number (POSIX), and not only its exit status, which nobody has asked for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    try:  # Linux: "pid (name) state ...", where the name may hold anything
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[0] not in "ZX"
    except (OSError, IndexError):
        return True


def shortened(text: str) -> str:
    """A message with its middle left out where what it quotes of a damaged file makes it longer than a reader bears."""
    return text if len(text) <= LONGEST_MESSAGE else f"{text[: LONGEST_MESSAGE - 200]} ... {text[-150:]}"


def reason(error: BaseException) -> str:
    """What went wrong, on one line of at most 200 characters."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(text.split())[:200]
