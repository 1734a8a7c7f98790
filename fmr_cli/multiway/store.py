"""The scans made ready, each read once; how many are kept at a time is bounded by their points, not by their number."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.sampling import thinned
from fmr_cli.io import read_cloud
from fmr_cli.io.files import atomic_write
from fmr_cli.multiway.scans import Scan
from fmr_cli.registration import prepare
from fmr_cli.registration.prepared import AT_MOST, Prepared

CACHED_POINTS = 20_000_000  # of the scans kept at a time; about 3 GB with what is prepared from them, at most
PREPARED = 100_000  # points that take as much memory as what registering prepares of a scan: 10 to 20 MB
SPILLED = 100_000  # points from which a file takes longer to read again than its thinned points do


class Store:
    """Scans by their number. Large ones are kept in ``spill`` (a folder, or None), thinned, to come back from there.

    edges: the voxel edge of each scan's grid, shared by scans of like size so that each is described once (``looks``).
    """

    def __init__(self, scans: Sequence[Scan] | dict[int, Scan], seed: int, spill: Path | None) -> None:
        self.scans, self.seed, self.spill = scans, seed, spill
        self.edges: dict[int, float] = {}
        self.kept: OrderedDict[int, Future[Prepared]] = OrderedDict()
        self.lock = threading.Lock()

    def prepared(self, number: int) -> Prepared:
        """A scan made ready, on its shared grid where that is known. Raises FmrError where it cannot be."""
        with self.lock:
            known = self.kept.get(number)
            future = self.kept.setdefault(number, known or Future())
            self.kept.move_to_end(number)
        if known is None:
            try:
                ready = prepare(self.points(number), self.seed)
                ready.name = str(self.scans[number].path or self.scans[number].name)
                future.set_result(ready)
            except BaseException as error:
                future.set_exception(error)
            self.let_go()
        ready = future.result()
        ready.edge = self.edges.get(number, ready.edge)
        return ready

    def points(self, number: int) -> PointCloud:
        """At most AT_MOST of a scan's points; the same ones from its file and from where they were spilled."""
        spilled = self.spilled(number)
        if spilled and spilled.is_file():
            return PointCloud(np.load(spilled))
        source = self.scans[number].source
        cloud = source if isinstance(source, PointCloud) else read_cloud(source, attributes=False)
        points = thinned(cloud.points, AT_MOST, np.random.default_rng(self.seed))
        if spilled and len(cloud) > SPILLED:
            spilled.parent.mkdir(exist_ok=True)
            with atomic_write(spilled) as temporary, temporary.open("wb") as file:
                np.save(file, points)
        return PointCloud(points)

    def spilled(self, number: int) -> Path | None:
        if self.spill is None or isinstance(self.scans[number].source, PointCloud):
            return None
        return self.spill / f"{self.scans[number].name}.npy"

    def clear(self) -> None:
        """Removes what was spilled."""
        if self.spill and self.spill.is_dir():
            for file in self.spill.iterdir():
                file.unlink()
            self.spill.rmdir()

    def let_go(self) -> None:
        """Lets go of the least recently used while they take more than CACHED_POINTS do."""
        with self.lock:
            ready = {n: f.result() for n, f in self.kept.items() if f.done() and not f.exception()}
            held = sum(len(r.points) + PREPARED for r in ready.values())
            for number, r in list(ready.items())[:-1]:
                if held > CACHED_POINTS:
                    held -= len(r.points) + PREPARED
                    del self.kept[number]
