"""Does one scan see through what another one has found? What tells rooms apart that resemble each other.

Two offices with the same walls fit each other nearly everywhere; what differs is a chair where the other scan has seen
the floor behind it. A scan taken from one place sees along straight lines, and up to its points everything is free. The
place is seldom known (scans are moved, formats drop it), but it shows: from there, and from nowhere else, no point of
the scan hides another.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.geometry.sampling import sample
from fmr_cli.registration.prepared import SPACINGS, Prepared

FINER = 2.0  # times the grid on which pairs are registered
ROWS = 60  # of the range image from pole to pole: cells of 3 degrees
BEHIND = 2.0  # fine edges, and SLANT of the range: a point that far behind another of its cell is hidden by it
SLANT = 0.08  # more, and from far off, where all lies at about one range, nothing would be hidden
APART = 3.0  # fine edges that a scan must see beyond a point to see through it
NEAR = 2.5  # fine edges within which a point has its counterpart
SEEN = 3  # points of a cell, below which it says nothing
STARTS, FEW, MANY, DESCENTS, STEPS = 300, 3_000, 12_000, 3, 50  # of the search for the viewpoint
SAMPLE = 4_000  # points that are brought into the other scan's view

# Shares of points that are seen through, on the building of `python -m benchmarks.multiway` with viewpoints found
# by the scans alone: right poses 0.000 to 0.020 (median 0.0005), wrong ones 0.010 to 0.38 (median 0.05).
CONTRADICTED = 0.01  # takes as much off a pose's log odds as the surest link has; see ``doubt``
ONE_PLACE = 0.004  # of each scan's best link, in the median: above it, scans were not taken from one place each

_columns = np.maximum((2 * ROWS * np.sin((np.arange(ROWS) + 0.5) / ROWS * np.pi)).astype(int), 1)
_first = np.concatenate([[0], np.cumsum(_columns)])  # number of each row's first cell


@dataclass(frozen=True)
class Viewed:
    """A scan as seen from where it was taken; centred. points (M, 3), tree; some (k, 3) of them; edge: of their grid.

    viewpoint (3,). nearest, count: range of the nearest point and number of points in each cell of the range image.
    """

    edge: float
    some: np.ndarray
    tree: cKDTree
    viewpoint: np.ndarray
    nearest: np.ndarray
    count: np.ndarray


def view(scan: Prepared, edge: float) -> Viewed:
    """The scan on a grid FINER than ``edge``, from the viewpoint that explains it best."""
    fine = min(max(edge / FINER, SPACINGS * scan.spacing), edge)
    points = scan.surface(fine).points
    rng = np.random.default_rng(scan.seed)
    place = viewpoint(points, fine, scan.frame.enter(np.zeros((1, 3)))[0], rng)
    nearest, count = range_image(points - place)
    return Viewed(fine, sample(points, SAMPLE, rng), cKDTree(points), place, nearest, count)


def viewpoint(points: np.ndarray, edge: float, guess: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The place (3,) within the scan's box from which the fewest of its points are hidden; ``guess`` is one start."""
    low, high = points.min(0), points.max(0)
    starts = np.clip(np.vstack([guess, points.mean(0), rng.uniform(low, high, (STARTS, 3))]), low, high)
    few, many = sample(points, FEW, rng), sample(points, MANY, rng)
    order = np.argsort([hidden(few - start, edge) for start in starts], kind="stable")
    found = []
    for place in starts[order[:DESCENTS]]:
        step, least = 0.06 * (high - low), hidden(many - place, edge)
        for _ in range(STEPS):
            other = np.clip(place + rng.normal(size=3) * step, low, high)
            share = hidden(many - other, edge)
            if share < least:
                place, least = other, share
            else:
                step = 0.92 * step
        found.append((least, place))
    return min(found, key=lambda x: x[0])[1]


def hidden(rays: np.ndarray, edge: float) -> float:
    """The share of points (N, 3), about a viewpoint, that another one of their cell hides."""
    cell, distance = cells(rays)
    nearest = np.full(_first[-1], np.inf)
    np.minimum.at(nearest, cell, distance)
    return float((distance * (1 - SLANT) > nearest[cell] + BEHIND * edge).mean())


def range_image(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range of the nearest point, and number of points, of each cell."""
    cell, distance = cells(rays)
    nearest = np.full(_first[-1], np.inf)
    np.minimum.at(nearest, cell, distance)
    return nearest, np.bincount(cell, minlength=_first[-1])


def cells(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cell of about 3 by 3 degrees that each of the rays (N, 3) lies in, and their lengths."""
    distance = np.sqrt((rays * rays).sum(1))
    polar = np.arccos(np.clip(rays[:, 2] / np.maximum(distance, 1e-300), -1, 1))
    row = np.minimum((polar * (ROWS / np.pi)).astype(int), ROWS - 1)
    turn = (np.arctan2(rays[:, 1], rays[:, 0]) + np.pi) / (2 * np.pi)
    return _first[row] + np.minimum((turn * _columns[row]).astype(int), _columns[row] - 1), distance


def contradiction(source: Viewed, target: Viewed, T_target_source: np.ndarray) -> float:
    """The larger share of one scan's points that the other sees through, of those it says anything about."""
    return max(
        seen_through(source, target, T_target_source), seen_through(target, source, np.linalg.inv(T_target_source))
    )


def seen_through(scan: Viewed, by: Viewed, T_by_scan: np.ndarray) -> float:
    points = scan.some @ T_by_scan[:3, :3].T + T_by_scan[:3, 3]
    edge = max(scan.edge, by.edge)
    near = np.isfinite(by.tree.query(points, distance_upper_bound=NEAR * edge)[0])
    cell, distance = cells(points - by.viewpoint)
    through = ~near & (by.count[cell] >= SEEN) & (by.nearest[cell] > distance + APART * edge)
    return float(through.sum() / max((through | near).sum(), 1))


def from_one_place(shares: Iterable[tuple[tuple[int, int], float]], bound: float) -> set[int]:
    """The scans that were taken from one place each, so that what they see through tells.

    shares: of pairs (i, j) that may be linked, what is seen through. Scans that such pairs connect are judged together:
    each one's least share, in the median, is at most ``bound``; of scans fused from many places it is more.
    """
    least: dict[int, float] = {}
    home: dict[int, int] = {}
    for (i, j), share in shares:
        for n in (i, j):
            least[n] = min(least.get(n, 1.0), share)
            home.setdefault(n, n)
        a, b = home[i], home[j]
        if a != b:
            home = {n: a if h == b else h for n, h in home.items()}
    groups = [[n for n in home if home[n] == g] for g in sorted(set(home.values()))]
    return {n for g in groups if np.median([least[k] for k in g]) <= bound for n in g}


def doubt(share: float) -> float:
    """What a share takes off a pose's log odds: nothing up to half of CONTRADICTED, 12 at it, 24 at twice of it."""
    return 0.0 if share < CONTRADICTED / 2 else 12.0 * share / CONTRADICTED
