"""What a model keeps of the sites that it was trained on: scans that stand in one frame, merged and thinned.

Two scans of such a site are found there one by one, and need not overlap (``registration.sites``). A scan that stands
wrong there would spoil the poses of others, and of places that look alike one may be taken for another. So each scan
has to be found again where it stands, by what all others show together; what is left of the parts that scans were
joined to grows together where one is found on the other as a whole; and a site on which scans are then found where
they don't stand is not kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.geometry.voxels import voxel_downsample
from fmr_cli.multiway.store import Store
from fmr_cli.registration import Options, prepare
from fmr_cli.registration.looks import SURE
from fmr_cli.registration.pipeline import on_site
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.sites import likeliest, same
from fmr_cli.training.self_registration import side_by_side
from fmr_cli.training.task import Show

FEWEST = 3  # scans of a site that is kept: of two, one may stand wrong, and nothing says so
# Of the scans of a site that are surely found by the others, those found where they don't stand: in places with rooms
# that look alike 2 of 21; of a street and an object none of 28 and of 20 (the places of `benchmarks.training`, by a
# script that is not in the project).
MISTAKEN = 0.05
DETAIL = 3.0  # points of a site across the voxel edge that suits its scans: with fewer, it would need larger voxels
COARSER = 1.26  # times the grid's edge, where a site has too many points: a surface keeps two thirds of them
PASSES = 3  # in which sites take in what is found there


@dataclass(frozen=True)
class Thin:
    """A scan as a site keeps it: points (N, 3), file's coordinates; edge: of the voxels that suit it."""

    points: np.ndarray
    edge: float


Part = dict[int, np.ndarray]  # by scan: T_part_scan (4, 4), from the file's coordinates


@dataclass(frozen=True)
class Sites:
    """Makes sites of the scans of ``store``, which are found there by the model file ``model``.

    late: whether there is no time left to look for more scans. thinned: by scan, what of it is kept.
    """

    store: Store
    model: Path | None
    late: Callable[[], bool]
    show: Show
    thinned: dict[int, Thin] = field(default_factory=dict)

    def learn(self, parts: Sequence[Part]) -> list[Part]:
        """The scans of each site that is worth keeping, largest first, of parts that scans have been joined to."""
        sites, rest = list[Part](), list[Part]()
        for part in parts:
            stay = self.confirmed(part)
            if stay:
                sites.append(stay)
            left = {n: T for n, T in part.items() if n not in stay}
            rest += [left] if len(part) < FEWEST else [{n: T} for n, T in left.items()]
        for _ in range(PASSES):
            before = len(sites) + len(rest)
            sites, rest = self.grown(sites, rest)
            if self.late() or len(sites) + len(rest) == before:
                break
        kept = []
        for site in sites:
            stay, elsewhere = self.by_the_others(site)
            if len(elsewhere) <= MISTAKEN * (len(stay) + len(elsewhere)):
                kept.append({n: T for n, T in site.items() if n not in elsewhere})
        return sorted(kept, key=len, reverse=True)

    def confirmed(self, part: Part) -> Part:
        """The scans of a part that stand where all others say, if they are enough; none otherwise.

        Where one is found elsewhere it moves, and all are sought again: what stands wrong hides where others belong.
        """
        if len(part) < FEWEST:
            return {}
        stay, elsewhere = self.by_the_others(part)
        if elsewhere:
            stay, _ = self.by_the_others(part | elsewhere)
        return stay if len(stay) >= FEWEST else {}

    def by_the_others(self, part: Part) -> tuple[Part, Part]:
        """The scans of a part that are found where they stand by all others; those found elsewhere, and where."""
        numbers = sorted(part)

        def found(number: int) -> np.ndarray | None:
            others = {n: T for n, T in part.items() if n != number}
            return self.placed(self.store.prepared(number), self.merged(others))

        again = side_by_side(found, numbers, partial(self.show, "sites: each scan by the others"))
        there = {n: T for n, T in zip(numbers, again, strict=True) if T is not None}
        stay = {n: part[n] for n, T in there.items() if same(self.store.prepared(n), T, part[n])}
        return stay, {n: T for n, T in there.items() if n not in stay}

    def grown(self, sites: list[Part], rest: list[Part]) -> tuple[list[Part], list[Part]]:
        """Each site, largest first, with smaller ones and parts that are found on it as a whole; the other parts."""
        done, waiting, parts = list[Part](), sorted(sites, key=len, reverse=True), sorted(rest, key=len, reverse=True)
        while waiting:
            site, *smaller = waiting
            merged = self.merged(site)
            waiting, joined = self.found_on(merged, smaller)
            parts, more = self.found_on(merged, parts)
            done.append(site | joined | more)
        return done, parts

    def found_on(self, site: Prepared, parts: list[Part]) -> tuple[list[Part], Part]:
        """Which parts are not found on a site; and the scans of those that are, where they stand there."""
        report = partial(self.show, "sites: further scans")
        poses = side_by_side(lambda part: self.placed(self.merged(part), site), parts, report)
        there: Part = {}
        for part, T_site_part in zip(parts, poses, strict=True):
            if T_site_part is not None:
                there |= {n: T_site_part @ T_part_scan for n, T_part_scan in part.items()}
        return [part for part, T in zip(parts, poses, strict=True) if T is None], there

    def placed(self, scan: Prepared, site: Prepared) -> np.ndarray | None:
        """T_site_scan, files' coordinates, of a scan or a part that is found on a site, if surely and in time."""
        if self.late():
            return None
        there = likeliest(on_site(scan, site, Options(model=self.model, seed=self.store.seed)))
        return there.found.T_target_source if there and there.found.confidence >= SURE else None

    def merged(self, scans: Part) -> Prepared:
        """What scans show together, made ready."""
        return prepare(PointCloud(self.points(scans)))

    def points(self, part: Part, most: int | None = None) -> np.ndarray:
        """(N, 3) what scans of one frame show together, thinned; at most so many points."""
        scans = {n: self.thin(n) for n in sorted(part)}
        every = np.concatenate([transform_points(part[n], scan.points) for n, scan in scans.items()])
        edge = float(np.median([scan.edge for scan in scans.values()])) / DETAIL
        thin = voxel_downsample(every, edge)
        while most is not None and len(thin) > most:
            edge *= COARSER
            thin = voxel_downsample(every, edge)
        return thin

    def thin(self, number: int) -> Thin:
        """A scan without the points that no site would keep: of many large ones all points are gigabytes."""
        if number not in self.thinned:
            scan = self.store.prepared(number)
            points = scan.frame.leave(voxel_downsample(scan.points, scan.edge / DETAIL))
            self.thinned[number] = Thin(points, scan.edge)
        return self.thinned[number]
