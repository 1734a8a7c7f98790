"""Reads the scans of a sequence, a little ahead of the registration, and makes each ready for it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.geometry.se3 import exp, log
from fmr_cli.io import read_cloud
from fmr_cli.sequence.deskew import scan_times, time_span
from fmr_cli.sequence.journal import Beginning
from fmr_cli.sequence.moving_scan import MovingScan, Within
from fmr_cli.sequence.prepared_scan import PreparedScan, prepare_scan
from fmr_cli.sequence.readers import Readers
from fmr_cli.sequence.scans import Scans
from fmr_cli.sequence.voxel_frame import VoxelFrame

READ_AHEAD = 2  # scans that are read while one is registered: enough to hide the disk, few enough for the memory
# A scan so many times larger or smaller than the usual one is not of this sequence: units differ by 10 or more.
ODD_SIZE = 10.0
SIZES_KEPT = 15  # scans before it that say what is usual


@dataclass
class Loaded:
    """One scan as it came from its file.

    scan: None where it cannot be used; the message in ``row`` says why. moving: where it was deskewed. cloud: with its
    attributes, where the map needs it and it was not. size: mean absolute coordinate, voxels; 0 where there is none.
    row: its part of the table.
    """

    index: int
    scan: PreparedScan | None = None
    moving: MovingScan | None = None
    cloud: PointCloud | None = None
    size: float = 0.0
    row: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Reading:
    """How a scan is read and made ready, as far as that goes without the motion before it; in any thread or process.

    keep_clouds: a map is made of the clouds. whole_way: the scan is not deskewed.
    """

    frame: VoxelFrame
    keep_clouds: bool
    whole_way: bool

    def __call__(self, index: int, name: str, source: Path | PointCloud) -> Loaded:
        loaded = Loaded(index, row={"frame": index, "file": name, "points": 0})
        begin = time.perf_counter()
        attributes = self.keep_clouds or not self.whole_way
        try:
            loaded.cloud = source if isinstance(source, PointCloud) else read_cloud(source, attributes=attributes)
        except CloudFileError as error:
            loaded.row["message"] = str(error)
            return loaded
        end = time.perf_counter()
        loaded.row |= {"points": len(loaded.cloud), "read_s": round(end - begin, 4)}
        if self.whole_way:
            self.make_ready(loaded, end)
        return loaded

    def make_ready(self, loaded: Loaded, begin: float) -> None:
        """Thin the cloud, once no motion is left in it; begin: when work on it did."""
        cloud = loaded.cloud
        assert cloud
        loaded.scan = loaded.moving.prepared() if loaded.moving else prepare_scan(cloud.points, self.frame)
        if loaded.scan is None:
            loaded.row["message"] = f"{cloud.name}: only {len(cloud)} points, too few to register"
        else:
            loaded.size = float(np.abs(loaded.scan.points).mean())
        loaded.cloud = cloud if self.keep_clouds and not loaded.moving else None
        loaded.row["prepare_s"] = round(time.perf_counter() - begin, 4)


class Loader:
    """The scans of a sequence, read and made ready.

    T_first_scan: the poses of the frames so far, (4, 4) each, file units; the list grows while the run goes on.
    The motion within each scan is undone, where ``beginning`` says so: at first by that between the two frames before
    it, in the first two scans by that which the run began with; once a scan is registered, by what ``within`` says of
    it. strict: a scan without times is an error then, else it is taken as it is. keep_clouds: a map is made of the
    clouds.
    """

    def __init__(
        self, scans: Scans, beginning: Beginning, T_first_scan: list[np.ndarray], *, strict: bool, keep_clouds: bool
    ) -> None:
        self.scans, self.beginning, self.T_first_scan = scans, beginning, T_first_scan
        self.deskewed, self.strict, self.keep_clouds = beginning.deskewed, strict, keep_clouds
        self.reading = Reading(beginning.frame, keep_clouds, whole_way=not beginning.deskewed)
        self.within: dict[int, Within] = {}  # by frame, of those registered
        self.usual_sizes: deque[float] = deque(maxlen=SIZES_KEPT)
        self.spans: dict[int, tuple[float, float] | None] = {}  # see ``time_span``, by frame

    def ahead(self, start: int, readers: Readers) -> Iterator[Loaded]:
        """Each scan from index ``start`` on, read while those before it are registered."""
        if self.deskewed:  # then they are made ready here, and reading them needs no process
            readers.without_process()
        waiting: deque[Callable[[], Loaded]] = deque()
        for index in range(start, len(self.scans)):
            for ahead in range(index + len(waiting), min(index + READ_AHEAD + 1, len(self.scans))):
                waiting.append(readers.hand_out(self.reading, *self._scan_of(ahead)))
            loaded = waiting.popleft()()
            if self.deskewed:  # only now, when the motion before it is known
                self._undo_motion(loaded)
            self._refuse_odd_size(loaded)
            yield loaded

    def _scan_of(self, index: int) -> tuple[int, str, Path | PointCloud]:
        return index, self.scans.name(index), self.scans.sources[index]

    def scan(self, index: int) -> PreparedScan:
        """A scan again, as it was registered. Raises FmrError where its file has changed."""
        loaded = self.reading(*self._scan_of(index))
        if self.deskewed:
            self._undo_motion(loaded)  # as it was registered, see ``within``
        if loaded.scan is None:
            raise FmrError(f"{self.scans.where(index)}: cannot be read again, it has changed; leave out --resume")
        return loaded.scan

    def cloud(self, index: int) -> PointCloud:
        """A scan again with all its attributes, for the map."""
        cloud = self.scans.read(index, attributes=True)
        moving = self._moving(cloud, index) if self.deskewed else None
        return moving.still() if moving else cloud

    def _undo_motion(self, loaded: Loaded) -> None:
        """Deskew a scan that was read, and make it ready; the frames before it must be known."""
        if loaded.cloud is None:
            return
        begin = time.perf_counter()
        self.spans[loaded.index] = time_span(loaded.cloud)
        try:
            loaded.moving = self._moving(loaded.cloud, loaded.index)
        except CloudFileError as error:
            loaded.cloud, loaded.row["message"] = None, str(error)
            return
        self.reading.make_ready(loaded, begin)

    def _moving(self, cloud: PointCloud, index: int) -> MovingScan | None:
        """The scan with its motion, by constant velocity until it is registered; None where it has no times."""
        try:
            times = revolution.times(cloud.points) if (revolution := self.beginning.revolution) else scan_times(cloud)
        except CloudFileError:
            if self.strict:
                raise
            return None
        share = self._share(index)
        within = self.within.get(index) or Within(exp(share * log(self._motion_before(index))))
        return MovingScan(cloud, times, within, share, self.beginning.frame)

    def _motion_before(self, index: int) -> np.ndarray:
        """T_before_last (4, 4), file units, of the two frames before this one; in the first two, as the run began."""
        if index < 2:
            return self.beginning.T_first_second
        return np.linalg.inv(self.T_first_scan[index - 2]) @ self.T_first_scan[index - 1]

    def _share(self, index: int) -> float:
        """How long a scan lasts over the time from one to the next; 1 where times begin anew in each scan."""
        if self.beginning.revolution:
            return self.beginning.revolution.share
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
