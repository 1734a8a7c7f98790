"""When a spinning scanner measured a point follows from its azimuth: where a revolution begins, and which way it goes.

Files without times don't say either, nor whether the motion was undone before they were written. Scans of one place
seen one after another tell: where points were seen at other moments, the motion leaves them apart. Lengths are in
voxels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.geometry.point_to_plane import linearise
from fmr_cli.geometry.se3 import adjoint, exp, log
from fmr_cli.sequence.local_map import COARSE, FINE, WIDE, LocalMap
from fmr_cli.sequence.moving_scan import MovingScan, Within
from fmr_cli.sequence.observability import LEAST_SIGMA, Matches
from fmr_cli.sequence.prepared_scan import PreparedScan, prepare_scan
from fmr_cli.sequence.scans import Scans
from fmr_cli.sequence.voxel_frame import VoxelFrame

# Places along the sequence, and scans one after another at each, that are asked; of EVERY scans one place at most where
# there are more than two, so that it costs little. By hand: in made-up drives six tell the beginning to a sector.
PLACES, AT_A_PLACE, EVERY = 6, 4, 8
STARTS = 24  # azimuths that a revolution may begin at: 15 deg apart
SECTORS, FILLED = 36, 0.9  # a scan is a revolution if it has points in so large a share of so many sectors
LEAST_OVERLAP = 0.3  # of two scans, for them to count: skewed ones, a few metres apart
# Of the time between scans, that a scan lasts by the places' median, at least. By hand: eight made-up drives without
# skew say 0.03 at most (street, campus, mine, warehouse; 16 to 64 beams). It is told too low where scans are so skewed
# that few points find partners: so the whole is tried, too, and how much better the scans then fit decides.
LEAST_SHARE = 0.06
# The share by which scans must fit each other better for it, in the median of the places: more than another thinning
# does; and in how many of the places they must fit better at all: one in six may be registered wrongly.
LEAST_GAIN, MOST = 0.02, 0.8


@dataclass(frozen=True)
class Revolution:
    """How points' times follow from their azimuth.

    start: where a revolution begins, turns from the x axis. counterclockwise: which way it goes, seen from +z. share:
    how long it lasts over the time from scan to scan.
    """

    start: float
    counterclockwise: bool
    share: float

    def __str__(self) -> str:
        way = "counter-clockwise" if self.counterclockwise else "clockwise"
        return f"points' times from azimuth: a revolution begins at {360 * self.start:.0f} deg, {way}"

    def times(self, points: np.ndarray) -> np.ndarray:
        """(N,), 0 to 1 over the scan, of points (N, 3) in the sensor's frame."""
        turns = (azimuth(points) - self.start) % 1.0
        return turns if self.counterclockwise else 1.0 - turns


def azimuth(points: np.ndarray) -> np.ndarray:
    """(N,), turns from the x axis, counter-clockwise about z, of points (N, 3) in the sensor's frame."""
    return np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) % 1.0


def is_revolution(cloud: PointCloud) -> bool:
    """Whether the scan looks to all sides."""
    sectors = np.unique((azimuth(cloud.points) * SECTORS).astype(int))
    return len(sectors) >= FILLED * SECTORS


def revolution(scans: Scans, frame: VoxelFrame) -> Revolution | None:
    """How the scans were measured, or None where nothing shows that the motion is still in them."""
    found = [place for first in places(len(scans)) if (place := register(scans, frame, first))]
    if len(found) < 2:  # one alone may be chance
        return None
    starts = (np.arange(STARTS) + 0.5) / STARTS
    evidence = [e for place in found for e in place.evidence(frame.sensor, starts)]
    along, weight = (np.array(part) for part in zip(*evidence, strict=True))  # (pairs, STARTS) each
    said = weight.mean(1)  # pairs registered wrongly have large motions, and would say more than all others
    bounded = np.minimum(1.0, np.median(said) / said)[:, None]
    along, weight = along * bounded, weight * bounded
    best = int(np.argmax(along.sum(0) ** 2 / weight.sum(0)))
    share = float(np.median(along[:, best] / weight[:, best]))
    if abs(share) < LEAST_SHARE:
        return None
    likely = [Revolution(float(starts[best]), share > 0, each) for each in (min(abs(share), 1.0), 1.0)]
    gains = np.array([place.gains(scans, frame, likely) for place in found])  # (places, likely)
    which = int(np.argmax(np.median(gains, axis=0)))
    gain = gains[:, which]
    return likely[which] if np.median(gain) > LEAST_GAIN and (gain > 0).mean() >= MOST else None


def places(count: int) -> list[int]:
    """The first scans at up to PLACES places spread over so many scans, none of them in two."""
    number = min(PLACES, max(count // EVERY, 2), count // AT_A_PLACE)
    return [count * (2 * k + 1) // (2 * number) - AT_A_PLACE // 2 for k in range(number)]


@dataclass(frozen=True)
class Place:
    """A few scans one after another, from number ``first`` on, each registered to the first of them as they are.

    poses: (4, 4) each, the first one's too; totals and matches: of the others, see ``Fit`` and ``Matches``.
    """

    first: int
    scans: list[PreparedScan]
    poses: list[np.ndarray]
    totals: list[float]
    matches: list[Matches]

    def motions(self) -> list[np.ndarray]:
        """(6,) each: the motion at each scan over the time to the next, as between its neighbours; scan axes."""
        steps = [log(np.linalg.inv(a) @ b) for a, b in pairwise(self.poses)]
        return [steps[0], *((a + b) / 2 for a, b in pairwise(steps)), steps[-1]]

    def evidence(self, sensor: np.ndarray, starts: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """For each later scan, by start: how much its points are apart along the motion, and how surely."""
        of_first, *others = self.motions()
        for scan, T_first_scan, matches, motion in zip(
            self.scans[1:], self.poses[1:], self.matches, others, strict=True
        ):
            u_first, u_scan = (
                (azimuth(points - sensor)[:, None] - starts) % 1.0 - 0.5
                for points in (matches.moved, scan.points[matches.index])
            )
            J = linearise(matches.moved, matches.moved, matches.map_normals, np.zeros(3))[1]
            apart = u_scan.T * (adjoint(T_first_scan) @ motion @ J) - u_first.T * (of_first @ J)
            both = np.vstack([apart, matches.distance])
            weight = matches.weight / max(matches.rms, LEAST_SIGMA) ** 2
            both -= (both * weight) @ J.T @ np.linalg.solve((J * weight) @ J.T, J)  # what another pose would do as well
            yield -(both[:-1] * weight) @ both[-1], (both[:-1] ** 2) @ weight

    def gains(self, scans: Scans, frame: VoxelFrame, likely: list[Revolution]) -> list[float]:
        """Of each, the share by which the scans' ``total`` falls once the motion within them is undone so."""
        clouds = [scans.read(self.first + k, attributes=False) for k in range(len(self.scans))]
        return [self.gain(clouds, frame, each) for each in likely]

    def gain(self, clouds: list[PointCloud], frame: VoxelFrame, likely: Revolution) -> float:
        """Of one; clouds: the scans as they were read."""
        still = []
        for cloud, motion in zip(clouds, self.motions(), strict=True):
            within = Within(exp(frame.twist_to_file(likely.share * motion)))
            scan = MovingScan(cloud, likely.times(cloud.points), within, likely.share, frame).prepared()
            if scan is None:
                return 0.0
            still.append(scan)
        local_map = LocalMap()
        local_map.insert(0, still[0], np.eye(4))
        after = [
            local_map.fit(scan, T, (COARSE, FINE), "prediction").total
            for scan, T in zip(still[1:], self.poses[1:], strict=True)
        ]
        return float(1 - np.sum(after) / np.sum(self.totals))


def register(scans: Scans, frame: VoxelFrame, first: int) -> Place | None:
    """The scans at a place, or None where they can't be registered surely, or not read."""
    try:
        read = [prepare_scan(scans.read(first + k, attributes=False).points, frame) for k in range(AT_A_PLACE)]
    except CloudFileError:
        return None
    place = Place(first, [scan for scan in read if scan], [np.eye(4)], [], [])
    if len(place.scans) < AT_A_PLACE:
        return None
    local_map, poses = LocalMap(), place.poses
    local_map.insert(0, place.scans[0], np.eye(4))
    for scan in place.scans[1:]:
        guess = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1] if len(poses) > 1 else np.eye(4)
        fits = [local_map.fit(scan, guess, edges, "prediction") for edges in ((WIDE, COARSE, FINE), (COARSE, FINE))]
        fit = min(fits, key=lambda fit: fit.total)
        T_first_scan, _, _, matches = local_map.surface.planes.fit(scan, fit.T_map_scan, 0.0)
        if matches is None or fit.overlap < LEAST_OVERLAP:
            return None
        poses.append(T_first_scan)
        place.totals.append(fit.total)
        place.matches.append(matches)
    return place
