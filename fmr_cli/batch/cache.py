"""Files read and prepared, each once however many pairs need it, within a bound."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Iterable
from concurrent.futures import Future
from pathlib import Path
from typing import NamedTuple

from fmr_cli.io import read_cloud
from fmr_cli.registration import Prepared, prepare
from fmr_cli.registration.prepared import AT_MOST

# Points of the files that are kept for later pairs: about 2 GB with what is prepared from them (100 bytes a point).
CACHED_POINTS = 20_000_000


class Key(NamedTuple):
    """All that a prepared file depends on."""

    path: Path
    seed: int


class CloudCache:
    """Files read and prepared, each once even when several threads ask for it.

    A file is let go once no pair needs it any more, and the least recently used where more than ``at_most`` points are
    kept.
    """

    def __init__(self, at_most: int = CACHED_POINTS) -> None:
        self.at_most = at_most
        self.needed: Counter[Path] = Counter()  # how many pairs are still to come that need it
        self.files: OrderedDict[Key, Future[Prepared]] = OrderedDict()
        self.lock = threading.Lock()

    def expect(self, paths: Iterable[Path]) -> None:
        """Each path once for each pair to come that needs it."""
        with self.lock:
            self.needed.update(paths)

    def get(self, path: Path, *, seed: int) -> Prepared:
        """A file's cloud; where it could not be read, the same error each time.

        seed: of the sample that is looked at where the file is large.
        """
        key = Key(path, seed)
        with self.lock:
            known = self.files.get(key)
            future = self.files.setdefault(key, known or Future())
            self.files.move_to_end(key)
        if known is None:
            try:
                future.set_result(prepare(read_cloud(path, attributes=False, at_most=AT_MOST), seed))
            except BaseException as error:
                future.set_exception(error)
            self._keep_within_bound()
        return future.result()

    def done_with(self, *paths: Path) -> None:
        """A pair of these files is done."""
        with self.lock:
            self.needed.subtract(paths)
            unneeded = {path for path in paths if self.needed[path] <= 0}
            for key in [key for key in self.files if key.path in unneeded]:
                del self.files[key]

    def _keep_within_bound(self) -> None:
        with self.lock:
            read = {key: len(f.result().points) for key, f in self.files.items() if f.done() and not f.exception()}
            held = sum(read.values())
            for key, points in read.items():
                if held > self.at_most:
                    held -= points
                    del self.files[key]
