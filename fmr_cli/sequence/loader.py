"""Reads the scans of a sequence, a little ahead of the registration, and makes each ready for it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.geometry.se3 import exp, log
from fmr_cli.sequence.deskew import deskew, scan_times, time_span
from fmr_cli.sequence.journal import Beginning
from fmr_cli.sequence.prepared_scan import PreparedScan, prepare_scan
from fmr_cli.sequence.scans import Scans

READ_AHEAD = 2  # scans that are read while one is registered: enough to hide the disk, few enough for the memory
# A scan so many times larger or smaller than the usual one is not of this sequence: units differ by 10 or more.
ODD_SIZE = 10.0
SIZES_KEPT = 15  # scans before it that say what is usual


@dataclass
class Loaded:
    """One scan as it came from its file.

    scan: None where it cannot be used; the message in ``row`` says why. cloud: with its attributes, deskewed, where
    the map needs it. size: mean absolute coordinate, voxels; 0 where there is none. row: its part of the table.
    """

    index: int
    scan: PreparedScan | None = None
    cloud: PointCloud | None = None
    size: float = 0.0
    row: dict[str, Any] = field(default_factory=dict)


class Loader:
    """The scans of a sequence, read and made ready.

    T_first_scan: the poses of the frames so far, (4, 4) each, file units; the list grows while the run goes on.
    deskewed: undo the motion within each scan, by that between the two frames before it; in the first two scans, by
    that which the run began with. keep_clouds: a map is made of the clouds.
    """

    def __init__(
        self, scans: Scans, beginning: Beginning, T_first_scan: list[np.ndarray], *, deskewed: bool, strict: bool,
        keep_clouds: bool,
    ) -> None:  # fmt: skip
        self.scans, self.beginning, self.T_first_scan = scans, beginning, T_first_scan
        self.deskewed, self.strict, self.keep_clouds = deskewed, strict, keep_clouds
        self.usual_sizes: deque[float] = deque(maxlen=SIZES_KEPT)
        self.spans: dict[int, tuple[float, float] | None] = {}  # see ``time_span``, by frame

    def ahead(self, start: int) -> Generator[Loaded, None, None]:
        """Each scan from index ``start`` on, read while those before it are registered."""
        with ThreadPoolExecutor(1) as reader:
            waiting: deque[Future[Loaded]] = deque()
            try:
                for index in range(start, len(self.scans)):
                    for ahead in range(index + len(waiting), min(index + READ_AHEAD + 1, len(self.scans))):
                        waiting.append(reader.submit(self._read, ahead))
                    loaded = waiting.popleft().result()
                    if self.deskewed:  # only now, when the motion before it is known
                        self._thin(loaded)
                    self._refuse_odd_size(loaded)
                    yield loaded
            finally:
                for future in waiting:
                    future.cancel()

    def scan(self, index: int) -> PreparedScan:
        """A scan again, as it was registered. Raises FmrError where its file has changed."""
        loaded = self._read(index)
        if self.deskewed:
            self._thin(loaded)
        if loaded.scan is None:
            raise FmrError(f"{self.scans.where(index)}: cannot be read again, it has changed; leave out --resume")
        return loaded.scan

    def cloud(self, index: int) -> PointCloud:
        """A scan again with all its attributes, for the map."""
        return self._without_motion(self.scans.read(index, attributes=True), index)

    def _read(self, index: int) -> Loaded:
        """Read one scan, and thin it where no motion is to be undone; runs beside the registration of others."""
        loaded = Loaded(index, row={"frame": index, "file": self.scans.name(index), "points": 0})
        begin = time.perf_counter()
        try:
            loaded.cloud = self.scans.read(index, attributes=self.keep_clouds or self.deskewed)
        except CloudFileError as error:
            loaded.row["message"] = str(error)
            return loaded
        if self.deskewed:
            self.spans[index] = time_span(loaded.cloud)
        loaded.row |= {"points": len(loaded.cloud), "read_s": round(time.perf_counter() - begin, 4)}
        if not self.deskewed:
            self._thin(loaded)
        return loaded

    def _thin(self, loaded: Loaded) -> None:
        """Make a scan that was read ready to register; to deskew it, the frames before it must be known."""
        if loaded.cloud is None:
            return
        begin = time.perf_counter()
        try:
            cloud = self._without_motion(loaded.cloud, loaded.index)
        except CloudFileError as error:
            loaded.cloud, loaded.row["message"] = None, str(error)
            return
        loaded.scan = prepare_scan(cloud.points, self.beginning.frame)
        if loaded.scan is None:
            loaded.row["message"] = f"{cloud.name}: only {len(cloud)} points, too few to register"
        else:
            loaded.size = float(np.abs(loaded.scan.points).mean())
        loaded.cloud = cloud if self.keep_clouds else None
        loaded.row["prepare_s"] = round(time.perf_counter() - begin, 4)

    def _without_motion(self, cloud: PointCloud, index: int) -> PointCloud:
        """The scan deskewed, by constant velocity from the two frames before it, for as long as it lasts."""
        if not self.deskewed:
            return cloud
        try:
            times = scan_times(cloud)
        except CloudFileError:
            if self.strict:
                raise
            return cloud
        T_begin_end = self.beginning.T_first_second
        if index > 1:
            T_begin_end = np.linalg.inv(self.T_first_scan[index - 2]) @ self.T_first_scan[index - 1]
        T_begin_end = exp(self._share(index) * log(T_begin_end))
        return replace(cloud, points=deskew(cloud.points, times, T_begin_end))

    def _share(self, index: int) -> float:
        """How long a scan lasts over the time from one to the next; 1 where times begin anew in each scan."""
        earlier, later, own = (self._span(i) for i in (max(index, 1) - 1, max(index, 1), index))
        if earlier is None or later is None or own is None or not later[0] > earlier[0]:
            return 1.0
        return min((own[1] - own[0]) / (later[0] - earlier[0]), 1.0)

    def _span(self, index: int) -> tuple[float, float] | None:
        if index not in self.spans:
            try:
                self.spans[index] = time_span(self.scans.read(index, attributes=True))
            except CloudFileError:
                self.spans[index] = None
        return self.spans[index]

    def _refuse_odd_size(self, loaded: Loaded) -> None:
        """A scan of quite another size than those before it is most often one in another unit."""
        if not loaded.size:
            return
        ratio = loaded.size / float(np.median(self.usual_sizes)) if self.usual_sizes else 1.0
        if 1 / ODD_SIZE < ratio < ODD_SIZE:
            self.usual_sizes.append(loaded.size)
            return
        loaded.row["message"] = f"{ratio:.3g} times the size of the scans before it, is it in another unit?"
        loaded.scan, loaded.size = None, 0.0
