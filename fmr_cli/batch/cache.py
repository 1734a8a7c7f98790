"""Files read and prepared, each once however many pairs need it, within a bound."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.io import read_cloud
from fmr_cli.registration import Prepared, prepare
from fmr_cli.registration.prepared import AT_MOST

# Points of the files that are kept for later pairs: about 2 GB with what is prepared from them (100 bytes a point).
CACHED_POINTS = 20_000_000


class Key(NamedTuple):
    """All that a prepared file depends on. changed: its time of change in ns and bytes, 0 where there is no file."""

    path: Path
    changed: tuple[int, int]
    seed: int


@dataclass(frozen=True)
class ReadyFile:
    """A file's cloud made ready. said: what the file says of it, without its points."""

    prepared: Prepared
    said: PointCloud


class CloudCache:
    """Files read and prepared, each once even when several threads ask for it.

    The least recently used is let go where more than ``at_most`` points are kept.
    """

    def __init__(self, at_most: int = CACHED_POINTS) -> None:
        self.at_most = at_most
        self.files: OrderedDict[Key, Future[ReadyFile]] = OrderedDict()
        self.lock = threading.Lock()

    def get(self, path: Path, *, seed: int) -> ReadyFile:
        """A file's cloud; where it could not be read, the same error each time.

        seed: of the sample that is looked at where the file is large.
        """
        key = Key(path, changed(path), seed)
        with self.lock:
            known = self.files.get(key)
            future = self.files.setdefault(key, known or Future())
            self.files.move_to_end(key)
        if known is None:
            try:
                cloud = read_cloud(path, attributes=False, at_most=AT_MOST)
                said = replace(cloud, points=np.empty((0, 3)), attributes={}, total=cloud.count)
                future.set_result(ReadyFile(prepare(cloud, seed), said))
            except BaseException as error:
                future.set_exception(error)
            self._keep_within_bound()
        return future.result()

    def let_go(self, paths: Collection[Path]) -> None:
        """No pair to come needs these files."""
        with self.lock:
            for key in [key for key in self.files if key.path in paths]:
                del self.files[key]

    def _keep_within_bound(self) -> None:
        with self.lock:
            done = {key: f.result() for key, f in self.files.items() if f.done() and not f.exception()}
            held = sum(len(ready.prepared.points) for ready in done.values())
            for key, ready in done.items():
                if held > self.at_most:
                    held -= len(ready.prepared.points)
                    del self.files[key]


def changed(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_size
