"""The user's scans registered with each other, by what has been learnt so far: where two of them see one place.

``multiway`` looks at pairs, registers the promising ones and joins what agrees, round cycles where there are any, and
nothing where views contradict it. Any two scans of one component then have a pose, also those that share too little for
``align`` to have found it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from fmr_cli.cores import usable_cores
from fmr_cli.errors import FmrError
from fmr_cli.geometry.frames import Frame, leave_frames
from fmr_cli.multiway.candidates import look_at_pairs
from fmr_cli.multiway.claims import AGREE
from fmr_cli.multiway.known import Known
from fmr_cli.multiway.looks import displacement
from fmr_cli.multiway.pipeline import at_work
from fmr_cli.multiway.reading import prepare
from fmr_cli.multiway.rounds import confirm, join_components, register_most_promising
from fmr_cli.multiway.scans import Scan
from fmr_cli.multiway.survey import Progress, Survey
from fmr_cli.multiway.workers import Threads
from fmr_cli.registration import Options
from fmr_cli.registration.agreement import agreement
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.refinement import by_geometry, by_planes

BANDS = {"small": (0.1, 0.3), "part": (0.3, 0.6), "much": (0.6, 1.01)}  # overlap; below, hardly a patch is in common
BLOCK = 8  # scans in a row that are drawn together where there are too many: what follows each other overlaps
STRIDES = (1, 2, 4, 8)  # between them: a spinning scanner's next scan shows nothing new
# Of the points explained, that a thing which one scan lacks may have at a pose that follows from others'. By hand: in a
# made-up building one wrong link of alike rooms makes dozens of wrong poses; of a street 19 of 20 right ones lack less.
LACKING = 0.01

Show = Callable[[Progress], None]


@dataclass(frozen=True)
class Placed:
    """Two of the scans, by number, that show one place.

    T_target_source: (4, 4), files' coordinates. overlap: share of the smaller one. edge: the voxel edge that suits
    both. direct: registered with each other; else their pose follows from others'.
    """

    source: int
    target: int
    T_target_source: list[list[float]]
    overlap: float
    edge: float
    direct: bool

    @property
    def ends(self) -> tuple[int, int]:
        return self.source, self.target

    @property
    def band(self) -> str:
        """How much they share, in a word."""
        return band(self.overlap)


@dataclass
class Found:
    """What registering some of the scans has given. said: in words; skipped: files that could not be read.

    parts: the scans that stand in one frame, by number: T_part_scan (4, 4), files' coordinates.
    """

    pairs: list[Placed]
    scans: list[int]
    said: str
    skipped: list[str]
    parts: list[dict[int, list[list[float]]]] = field(default_factory=list)

    def joined(self) -> bool:
        """Whether the pairs join all the scans into one part: there is no other place for any of them."""
        reached, front = set[int](), set(self.scans[:1])
        while front:
            reached |= front
            front = {n for pair in self.pairs for n in pair.ends if front & set(pair.ends)} - reached
        return len(reached) == len(self.scans)

    def plain(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of(cls, plain: dict[str, Any]) -> Found:
        parts = [{int(n): T for n, T in part.items()} for part in plain.get("parts", [])]
        return cls(**plain | {"pairs": [Placed(**pair) for pair in plain["pairs"]], "parts": parts})


def band(overlap: float) -> str:
    """The name of the BANDS that an overlap is in."""
    return next((name for name, (low, high) in BANDS.items() if low <= overlap < high), "none")


def drawn(count: int, most: int, rng: np.random.Generator) -> list[int]:
    """At most ``most`` of ``count`` scans, by number: all, or rows of BLOCK with one of STRIDES between neighbours."""
    if count <= most:
        return list(range(count))
    chosen: set[int] = set()
    while len(chosen) < most:
        stride = int(rng.choice([s for s in STRIDES if s * BLOCK <= count] or [1]))
        first = int(rng.integers(max(count - stride * (BLOCK - 1), 1)))
        chosen.update(range(first, min(first + stride * BLOCK, count), stride))
    return sorted(chosen)[:most]


def register_scans(
    scans: Sequence[Scan], numbers: list[int], model: Path | None, most: int, seed: int, show: Show = lambda _: None
) -> Found:
    """Registers the scans ``numbers`` with each other; at most ``most`` pairs that show one place, of all overlaps.

    Scans that cannot be read are left out. Raises FmrError where none can be read.
    """
    survey = Survey([scans[n] for n in numbers], Options(model=model), Known(), None, Threads(), show)
    with at_work(survey, resume=False):
        prepare(survey)
        look_at_pairs(survey)
        register_most_promising(survey)
        join_components(survey)
        confirm(survey)
        candidates = overlapping(survey)
        rng = np.random.default_rng(seed)
        chosen = of_all_bands(candidates, most, rng)
        placed = [p for p in survey.each("placing", lambda c: settled(survey, *c), chosen) if p is not None]
    pairs = [Placed(**vars(p) | {"source": numbers[p.source], "target": numbers[p.target]}) for p in placed]
    skipped = [f"{scans[numbers[n]].source}: {survey.messages[n]}" for n in sorted(survey.failed)]
    parts = [
        {numbers[n]: leave_frames(T, survey.frames[n], Frame()).tolist() for n, T in c.T_component_scan.items()}
        for c in survey.components
    ]
    return Found(pairs, sorted(numbers[n] for n in survey.edges), in_words(survey, pairs), skipped, parts)


def overlapping(survey: Survey) -> list[tuple[int, int, np.ndarray, float]]:
    """(source, target, T between centred frames, overlap) of all pairs in one part that share enough."""
    found = []
    for component in survey.components:
        poses = component.T_component_scan
        members = sorted(poses)
        for k, j in enumerate(members):
            for i in members[k + 1 :]:
                T = np.linalg.inv(poses[j]) @ poses[i]
                if survey.possible(i, j) and (shared := survey.overlap(i, j, T)) >= BANDS["small"][0]:
                    found.append((i, j, T, shared))
    return found


def of_all_bands(
    candidates: list[tuple[int, int, np.ndarray, float]], most: int, rng: np.random.Generator
) -> list[tuple[int, int, np.ndarray, float]]:
    """At most ``most``, as many of each band as there are: little overlap is what there is most to learn from."""
    shuffled = [candidates[i] for i in rng.permutation(len(candidates))]
    rows = [[c for c in shuffled if band(c[3]) == name] for name in BANDS]
    taken = [c for turn in range(most) for row in rows if turn < len(row) for c in (row[turn],)]
    return sorted(taken[:most], key=lambda c: c[:2])


def settled(survey: Survey, source: int, target: int, T: np.ndarray, overlap: float) -> Placed | None:
    """The pair at its own registered pose where it has one that agrees; else at ``T``, which follows from others'.

    That is refined where enough is shared: of little, surfaces say less than the links of others do (measured on depth
    views of an object: composed over two links half a voxel off, refined at 15 % overlap five). None where more speaks
    against the pose than for it, or, where it follows from others', one scan lacks a thing there.
    """
    moment = survey.description(source, survey.edges[source]).moment
    link = survey.links.get((max(source, target), min(source, target)))
    own = [h.T_target_source for h in link.hypotheses] if link is not None and link.status == "aligned" else []
    if link is not None and link.ends != (source, target):
        own = [np.linalg.inv(pose) for pose in own]
    try:
        pair = make_pair(survey.store.prepared(source), survey.store.prepared(target), survey.options)
    except FmrError:
        return None
    reach = AGREE * pair.edge
    near = [pose for pose in own if float(displacement(pose, T, moment)) < 2 * reach]
    pose = near[0] if near else T
    if not near and overlap >= BANDS["part"][0]:
        refined = by_geometry(pair, by_planes(pair, T)).T_target_source
        pose = refined if float(displacement(refined, T, moment)) < reach else T
    fit = agreement(pair.s, pair.t, pose)
    if fit.contradicted > fit.explained or (not near and fit.missing > LACKING * fit.explained):
        return None
    files = leave_frames(pose, survey.frames[source], survey.frames[target])
    return Placed(source, target, files.tolist(), overlap, pair.edge, bool(near))


def in_words(survey: Survey, pairs: list[Placed]) -> str:
    """What a round has found."""
    aligned = sum(link.status == "aligned" for link in survey.links.values())
    together = [len(c.T_component_scan) for c in survey.components if len(c.T_component_scan) > 1]
    if not pairs:
        return (
            f"{len(survey.edges)} scans, {len(survey.links)} pairs registered: none is sure to show one place; "
            "learning from single scans alone"
        )
    bands = ", ".join(f"{sum(p.band == name for p in pairs)} at {name}" for name in BANDS)
    return (
        f"{len(survey.edges)} scans: {aligned} of {len(survey.links)} registered pairs aligned, {sum(together)} scans "
        f"in {len(together)} part{'s' if len(together) > 1 else ''}; {len(pairs)} pairs show one place, "
        f"{sum(p.direct for p in pairs)} of them aligned themselves ({bands} overlap)"
    )


def side_by_side(work: Callable[[Any], Any], items: Sequence[Any], show: Callable[[int, int], None]) -> list[Any]:
    """The results of ``work`` on all items, in their order, on all cores."""
    found = []
    with threadpool_limits(1), ThreadPoolExecutor(usable_cores()) as pool:
        for result in pool.map(work, items):
            found.append(result)
            show(len(found), len(items))
    return found
