"""Which scans: files, folders and lists of files as one list in natural order, each with a name of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fmr_cli.batch.manifest import numbered, safe
from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.io import check_scan, holds_scans, scan_paths
from fmr_cli.io.addresses import address_of, located
from fmr_cli.io.files import check_readable
from fmr_cli.io.folders import find_scans, natural
from fmr_cli.io.parts import label_of

LISTS = (".lst", ".list")  # and a .txt whose first line names a file


@dataclass(frozen=True)
class Scan:
    """One scan to place. name: unique among all, safe as a file name. source: its file, or a cloud in memory."""

    name: str
    source: Path | PointCloud

    @property
    def path(self) -> Path | None:
        return self.source if isinstance(self.source, Path) else self.source.path


def list_scans(given: Iterable[str | Path | PointCloud], out: Path | None = None) -> list[Scan]:
    """The scans of files, folders, text files that list scans, and clouds in memory, in natural order of their names.

    Equal stems are told apart by their folders. ``out``: a folder whose files are no scans. Raises FmrError where a
    path is not there or fewer than two scans are.
    """
    sources: list[Path | PointCloud] = []
    for item in given:
        if isinstance(item, PointCloud):
            sources.append(item)
            continue
        path = Path(item)
        if holds_scans(path):
            sources += scan_paths(path)
        elif path.is_dir():
            sources += [
                file for file in find_scans([path]) if out is None or out.resolve() not in file.resolve().parents
            ]
        elif is_list(path):
            sources += in_list(path)
        else:
            check_scan(path)
            sources.append(path)
    if len(sources) < 2:
        where = ", ".join(str(item) for item in given if not isinstance(item, PointCloud)) or "the list of clouds"
        raise FmrError(
            f"{where}: {'one scan' if sources else 'no scan'} only, a network has two or more; give more files"
        )
    named = [Scan(name, source) for name, source in zip(names(sources), sources, strict=True)]
    return sorted(named, key=lambda scan: natural(scan.name))


def is_list(path: Path) -> bool:
    """Whether a file lists scans: by its suffix, or a .txt whose first line names a file."""
    if path.suffix.lower() in LISTS:
        return True
    if path.suffix.lower() != ".txt" or not path.is_file():
        return False
    with path.open(encoding="utf-8", errors="replace") as file:
        line = next((text for text in file if text.strip() and not text.lstrip().startswith("#")), "")
    name = line.split("#")[0].strip()
    return address_of(name) is not None or (path.parent / name).is_file()


def in_list(path: Path) -> list[Path]:
    """The files that a text file names, one a line, relative to it; # begins a comment. Raises CloudFileError."""
    check_readable(path)
    lines = (line.split("#")[0].strip() for line in path.read_text("utf-8", errors="replace").splitlines())
    files = [located(path.parent, line) for line in lines if line]
    missing = next((file for file in files if not address_of(file) and not file.is_file()), None)
    if missing or not files:
        what = f"lists {missing}, which is not there" if missing else "lists no scans"
        raise CloudFileError(f"{path}: {what}; name one scan file a line")
    return files


def names(sources: Sequence[Path | PointCloud]) -> list[str]:
    """A name for each: its stem, with as many of its folders (then its suffix) as tell equal ones apart."""
    paths = [source if isinstance(source, Path) else source.path for source in sources]
    found = [label_of(path) if path else f"cloud_{number:03d}" for number, path in enumerate(paths)]
    for depth in (1, 2, 3):
        files = {(name.casefold(), path.resolve() if path else None) for name, path in zip(found, paths, strict=True)}
        count = Counter(name for name, _ in files)  # one file given twice is no reason to call it by its folder
        for number, path in enumerate(paths):
            if path and count[found[number].casefold()] > 1:
                folders = path.resolve().parent.parts[-depth:]
                found[number] = "_".join([*folders, label_of(path) if depth < 3 else path.name])
    taken: set[str] = set()
    unique = []
    for name in map(safe, found):
        unique.append(next(free for free in numbered(name) if free.casefold() not in taken))
        taken.add(unique[-1].casefold())
    return unique
