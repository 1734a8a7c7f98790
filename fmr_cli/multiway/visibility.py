"""Does one scan see through what another one has found? What tells rooms apart that resemble each other.

Two offices with the same walls fit each other nearly everywhere; what differs is a chair where the other scan has seen
the floor behind it. A scan taken from one place sees along straight lines, and up to its points everything is free. The
place is seldom known (scans are moved, formats drop it), but it shows: from there, and from nowhere else, no point of
the scan hides another.

A surface that is seen edge-on says nothing, neither of the viewpoint nor of the other scan: within one cell of a range
image it reaches from near to far, and a scanner that stands in a doorway sees the wall beside it and what is behind by
the same ray, but for a centimetre.

A scan sees the near side of what it sees. Two rooms that are put back to back see nothing of each other but a wall that
coincides, one its near side, the other its far side: what lies close but faces the other way is no agreement either.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.multiway.parts import parts
from fmr_cli.registration.prepared import SPACINGS, Prepared

FINER = 2.0  # times the grid on which pairs are registered
ROWS = 60  # of the range image from pole to pole: cells of 3 degrees
BEHIND = 2.0  # fine edges, and SLANT of the range: a point that far behind another of its cell is hidden by it
SLANT = 0.08  # more, and from far off, where all lies at about one range, nothing would be hidden
APART = 3.0  # fine edges that a scan must see beyond a point to see through it
NEAR = 2.5  # fine edges within which a point has its counterpart
SEEN = 3  # points of a cell, below which it says nothing
FACING, SQUARE = 0.3, 0.4  # |cosine| between ray and normal from which a surface counts: seen through, hidden
STARTS, FEW = 160, 2_000  # random places that the search for the viewpoint begins with, and points they are tried on
DESCENTS, GENERATIONS, DRAWS, ELITE, MANY = 3, 6, 18, 5, 5_000  # from the best of them, by the cross-entropy method
AS_GOOD = (
    0.002  # share of hidden points more than at the best place that leaves a scanner where its file has the origin
)
SAMPLE, HASTY = 4_000, 250  # points that are brought into the other scan's view, and where most poses are wrong

# Shares of points on the building of `python -m benchmarks.multiway`, with viewpoints found by the scans alone. Seen
# through: right poses 0.000 to 0.0075, wrong ones of rooms that resemble each other 0.009 to 0.06. From behind, of
# those with a counterpart: right poses at most 0.001, a wall's one side on its other side 0.22 to 0.48, rooms back to
# back over 0.9. Hidden: 0.004 to 0.04, in the median 0.013; of fragments fused from a moving camera 0.04 to 0.11.
CONTRADICTED = 0.006  # seen through
FROM_BEHIND = 0.15  # seen from behind
OPPOSED = -0.5  # cosine of the normals of two near points, each towards its viewpoint, that are two sides of a thing
LITTLE = 500  # agreeing points that are added to each count, so that a few points of few contradict nothing
HIDDEN, NO_PLACE = 0.03, 0.06  # of points, from the best viewpoint: in the median over scans; of any one scan
ONE_PLACE = 0.4  # contradiction of each best link, in the median: above it, scans were not taken from one place each

_columns = np.maximum((2 * ROWS * np.sin((np.arange(ROWS) + 0.5) / ROWS * np.pi)).astype(int), 1)
_first = np.concatenate([[0], np.cumsum(_columns)])  # number of each row's first cell


@dataclass(frozen=True)
class Viewed:
    """A scan as seen from where it was taken; centred. edge: of its grid; tree: of all its points.

    facing (M, 3): all points' normals, on the viewpoint's side. some, normals (k, 3): of a few points, likewise.
    viewpoint (3,); hidden: share of points that are hidden from there. nearest, count: range of the nearest point and
    number of points in each cell of the range image.
    """

    edge: float
    tree: cKDTree
    facing: np.ndarray
    some: np.ndarray
    normals: np.ndarray
    viewpoint: np.ndarray
    hidden: float
    nearest: np.ndarray
    count: np.ndarray


class Seen(NamedTuple):
    """What scans say of each other at a pose, in points: seen through, seen from behind, agreeing.

    hidden: share of one's own points that are hidden from the place where it seems to have been taken, at most.
    """

    through: int
    behind: int
    agreeing: int
    hidden: float = 0.0

    @property
    def seen_through(self) -> float:
        """From 0; at 1, two scans aren't where they are said to be, whether they are linked or not."""
        return self.through / (self.through + self.behind + self.agreeing + LITTLE) / CONTRADICTED

    @property
    def contradiction(self) -> float:
        """From 0; at 1 a link is contradicted: what it rests on must not be a wall that is seen from two rooms."""
        return max(self.seen_through, self.behind / (self.behind + self.agreeing + LITTLE) / FROM_BEHIND)

    def __str__(self) -> str:
        told = max(self.through + self.behind + self.agreeing, 1)
        if self.behind / FROM_BEHIND > self.through / CONTRADICTED:
            return f"{self.behind / told:.0%} of what they share there, they see from opposite sides"
        return f"one scan sees through {self.through / told:.1%} of the other there"


def total(seen: Iterable[Seen]) -> Seen:
    """What many pairs say together."""
    through, behind, agreeing, hidden = zip(Seen(0, 0, 0), *seen, strict=True)
    return Seen(sum(through), sum(behind), sum(agreeing), max(hidden))


def view(scan: Prepared, edge: float) -> Viewed:
    """The scan on a grid FINER than ``edge``, from the viewpoint that explains it best."""
    fine = min(max(edge / FINER, SPACINGS * scan.spacing), edge)
    surface = scan.surface(fine)
    rng = np.random.default_rng(scan.seed)
    order = rng.permutation(len(surface.points))  # samples are its beginnings
    points, normals = surface.points[order], surface.normals[order]
    place = viewpoint(points, normals, fine, scan.frame.enter(np.zeros((1, 3)))[0], rng)
    nearest, count = range_image(points - place)
    facing = towards(place, surface.points, surface.normals)
    some = facing[order[:MANY]]
    share = hidden((points[:MANY] - place).astype(np.float32), some.astype(np.float32), fine)
    return Viewed(fine, surface.tree, facing, points[:SAMPLE], some[:SAMPLE], place, share, nearest, count)


def towards(place: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The normals (N, 3) of points, each turned to the side that is seen from ``place``."""
    return np.where(np.einsum("ni,ni->n", place - points, normals)[:, None] < 0, -normals, normals)


def viewpoint(
    points: np.ndarray, normals: np.ndarray, edge: float, origin: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The place (3,) within the scan's box from which the fewest of its points (N, 3), in random order, are hidden.

    origin: that of the scan's file, where it lies in the box and is about as good as the best.
    """
    low, high = points.min(0), points.max(0)
    x, n = points.astype(np.float32), normals.astype(np.float32)  # exact enough for cells of 3 degrees, and faster

    def share(place: np.ndarray, count: int) -> float:
        return hidden(x[:count] - place.astype(np.float32), n[:count], edge)

    starts = np.vstack([points.mean(0), rng.uniform(low, high, (STARTS, 3))])
    starts = starts[np.argsort([share(start, FEW) for start in starts], kind="stable")[:DESCENTS]]
    found = [descend(lambda place: share(place, MANY), start, low, high, rng) for start in starts]
    least, best = min(found, key=lambda item: item[0])
    if np.all((low <= origin) & (origin <= high)) and share(origin, MANY) <= least + AS_GOOD:
        return origin
    return best


def descend(
    share: Callable[[np.ndarray], float], start: np.ndarray, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """The least share and its place, about a start: draws from a normal distribution that follows the best of them."""
    mean, std, best = start, 0.06 * (high - low), (share(start), start)
    for _ in range(GENERATIONS):
        places = np.clip(mean + rng.normal(size=(DRAWS, 3)) * std, low, high)
        shares = np.array([share(place) for place in places])
        elite = np.argsort(shares, kind="stable")[:ELITE]
        if shares[elite[0]] < best[0]:
            best = float(shares[elite[0]]), places[elite[0]]
        mean, std = places[elite].mean(0), 0.5 * places[elite].std(0) + 0.25 * std
    return best


def hidden(rays: np.ndarray, normals: np.ndarray, edge: float) -> float:
    """The share of points (N, 3), about a viewpoint and SQUARE to it, that another one of their cell hides."""
    cell, distance = cells(rays)
    nearest = np.full(_first[-1], np.inf, distance.dtype)
    np.minimum.at(nearest, cell, distance)
    square = np.abs(np.einsum("ni,ni->n", rays, normals)) > SQUARE * distance
    behind = distance * (1 - SLANT) > nearest[cell] + BEHIND * edge
    return float((behind & square).sum() / max(square.sum(), 1))


def range_image(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range of the nearest point, and number of points, of each cell."""
    cell, distance = cells(rays)
    nearest = np.full(_first[-1], np.inf)
    np.minimum.at(nearest, cell, distance)
    return nearest, np.bincount(cell, minlength=_first[-1])


def cells(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cell of about 3 by 3 degrees that each of the rays (N, 3) lies in, and their lengths."""
    distance = np.sqrt((rays * rays).sum(1))
    polar = np.arccos(np.clip(rays[:, 2] / np.maximum(distance, 1e-30), -1, 1))
    row = np.minimum((polar * (ROWS / np.pi)).astype(int), ROWS - 1)
    turn = (np.arctan2(rays[:, 1], rays[:, 0]) + np.pi) / (2 * np.pi)
    return _first[row] + np.minimum((turn * _columns[row]).astype(int), _columns[row] - 1), distance


def compare(source: Viewed, target: Viewed, T_target_source: np.ndarray, count: int = SAMPLE) -> Seen:
    """What two scans say of each other at a pose, by ``count`` points of each; nothing if no viewpoint explains one."""
    least = max(source.hidden, target.hidden)
    if least > NO_PLACE:
        return Seen(0, 0, 0, least)
    inverse = np.linalg.inv(T_target_source)
    said = (seen_by(target, source, T_target_source, count), seen_by(source, target, inverse, count))
    return total(said)._replace(hidden=least)


def seen_by(viewer: Viewed, scan: Viewed, T_viewer_scan: np.ndarray, count: int) -> Seen:
    """What a viewer says of those of a scan's first points whose surface faces it, on either side.

    Only where it has points enough to see through them if it did: elsewhere it finds nothing against any pose, and
    what a sparse scan cannot deny is no agreement.
    """
    R, t = T_viewer_scan[:3, :3], T_viewer_scan[:3, 3]
    points, normals = scan.some[:count] @ R.T + t, scan.normals[:count] @ R.T
    edge = max(scan.edge, viewer.edge)
    rays = points - viewer.viewpoint
    cell, distance = cells(rays)
    facing = np.abs(np.einsum("ni,ni->n", rays, normals)) > FACING * distance
    told = facing & (viewer.count[cell] >= SEEN)
    gap, counterpart = viewer.tree.query(points, distance_upper_bound=NEAR * edge)
    near = np.isfinite(gap)
    through = told & ~near & (viewer.nearest[cell] > distance + APART * edge)
    met = told & near
    opposed = np.einsum("ni,ni->n", normals[met], viewer.facing[counterpart[met]]) < OPPOSED
    return Seen(int(through.sum()), int(opposed.sum()), int((~opposed).sum()))


def beyond(viewer: Viewed, scan: Viewed, T_viewer_scan: np.ndarray) -> float:
    """The share of a few of a scan's points beyond which a viewer sees: hasty, without a search for counterparts."""
    rays = scan.some[:HASTY] @ T_viewer_scan[:3, :3].T + (T_viewer_scan[:3, 3] - viewer.viewpoint)
    cell, distance = cells(rays)
    past = (viewer.count[cell] >= SEEN) & (viewer.nearest[cell] > distance * (1 + SLANT) + APART * viewer.edge)
    return float(past.mean())


def from_one_place(found: Iterable[tuple[tuple[int, int], Seen]], bound: float = ONE_PLACE) -> set[int]:
    """The scans that were taken from one place each, so that their views tell.

    found: of pairs (i, j) that may be linked, what they see. Scans that such pairs connect are judged together: each
    one's least contradiction, in the median, is at most ``bound``, and so is what is hidden of itself at most HIDDEN;
    of scans fused from many places it is more.
    """
    least: dict[int, float] = {}
    hidden: dict[int, float] = {}
    pairs: list[tuple[int, int]] = []
    for (i, j), seen in found:
        pairs.append((i, j))
        for n in (i, j):
            least[n] = min(least.get(n, np.inf), seen.contradiction)
            hidden[n] = min(hidden.get(n, np.inf), seen.hidden)
    home = parts(least, pairs)
    groups = [[n for n in home if home[n] == g] for g in sorted(set(home.values()))]
    one_place = (
        g for g in groups if np.median([least[k] for k in g]) <= bound and np.median([hidden[k] for k in g]) <= HIDDEN
    )
    return {n for g in one_place for n in g}


def doubt(seen: Seen | None) -> float:
    """What a contradiction takes off a pose's log odds: 12 at 1, which no single link outweighs, by its square."""
    return 12.0 * seen.contradiction**2 if seen else 0.0
