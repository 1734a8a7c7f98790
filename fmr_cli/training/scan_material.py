"""What is learnt from the user's scans: patches of places that two of them show, found by registering them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import FmrError, ModelError
from fmr_cli.multiway.scans import Scan
from fmr_cli.multiway.store import Store
from fmr_cli.registration.prepared import pair_edge
from fmr_cli.synthetic.sensors import overlap
from fmr_cli.training.local_views import Views, make_material
from fmr_cli.training.processes import rank_and_world, wait_for_all
from fmr_cli.training.recipe import ScanRecipe
from fmr_cli.training.run_folder import TrainingError
from fmr_cli.training.scan_views import Overlapping, drawn_views, made_up_pair, seen_twice, whole_views
from fmr_cli.training.self_registration import BANDS, Found, Placed, drawn, register_scans, side_by_side
from fmr_cli.training.sites import Part
from fmr_cli.training.task import Files, Show

ROUNDS = "registered.json"
SCANS, MADE_UP = "held-out scans", "made-up scans"  # what is tested
SHARES = {"registered": 0.5, "single": 0.15, "made up": 0.35}  # of a step's pairs, where there are all three
MOST_LOOKS = 4  # views of one pair in a round: more show the same
TESTED_KEYPOINTS = 600  # of each scan; all of them take twice the time
TESTED_MADE_UP = 6  # pairs
FEWEST_TESTED = 4  # held-out pairs; where there are fewer, parts of held-out scans stand in
CUT_SHARES = (0.2, 0.45, 0.75)  # of the surface, that two parts of a held-out scan share: one of each of BANDS


class ScanMaterial:
    """The user's ``scans``, registered round by round, and views of what they show, to learn from and to test on.

    rounds: what each has found. views: what the steps draw from, by the names of ``SHARES``; tests: what is held out,
    by SCANS and MADE_UP. labelled: pairs whose pose is known beforehand.
    """

    def __init__(self, recipe: ScanRecipe, scans: list[Scan], labelled: list[Placed]) -> None:
        self.recipe, self.scans, self.labelled = recipe, scans, labelled
        self.held_out = held_out(len(scans), recipe.held_out, recipe.seed)
        self.store = Store(scans, recipe.seed, None)
        self.rounds: list[Found] = []
        self.views: dict[str, list[Views]] = {name: [] for name in SHARES}
        self.tests: dict[str, list[Views]] = {}

    def described(self) -> list[str]:
        """What it is, for the card."""
        named = f"{len(self.scans)} scan{'s' if len(self.scans) > 1 else ''}, {len(self.held_out)} of them held out"
        return [named, *([f"{len(self.labelled)} pairs of known pose"] if self.labelled else [])]

    def round_at(self, step: int, steps: int) -> int:
        """Which round a step belongs to."""
        return min(step * self.recipe.rounds // max(steps, 1), self.recipe.rounds - 1)

    def renewals(self) -> int:
        return self.recipe.rounds - len(self.rounds)

    def renew(
        self, step: int, steps: int, current: Callable[[int], Path | None], files: Files, show: Show
    ) -> list[str]:
        """Registers the scans anew where a round begins; its pairs' views take the place of the last ones.

        current: gives the model file that a round registers by.
        """
        notes: list[str] = []
        while len(self.rounds) <= self.round_at(step, steps):
            found = self.registered(len(self.rounds), current, files, show)
            notes += [f"warning: {said}" for said in found.skipped if not self.rounds]
            self.rounds.append(found)
            notes.append(f"round {len(self.rounds)}: {found.said}")
        if notes:
            self.make_views(len(self.rounds) - 1, show)
        return notes

    def registered(self, number: int, current: Callable[[int], Path | None], files: Files, show: Show) -> Found:
        """What a round has found: from the run's folder, or by registering; by the first process for all."""
        path = files.path / ROUNDS
        known = read_rounds(path)
        rank, _ = rank_and_world()
        if rank == 0 and len(known) <= number:
            recipe = self.recipe
            chosen = drawn(len(self.scans), recipe.scans, np.random.default_rng((recipe.seed, number)))
            if len(chosen) < 2:
                found = Found([], chosen, "one scan: learning from parts of it", [])
            elif known and len(chosen) == len(self.scans) and known[-1].joined():
                found = replace(known[-1], said="all scans are in one part already; their pairs are looked at anew")
            else:
                found = register_scans(
                    self.scans, chosen, current(number), 2 * recipe.pairs, recipe.seed + number,
                    lambda p: show(f"round {number + 1}: {p.stage}", p.done, p.total),
                )  # fmt: skip
            known = [*known, found]
            files.write(ROUNDS, json.dumps([f.plain() for f in known], indent=1) + "\n")
        wait_for_all()
        return read_rounds(path)[number]

    def trains(self, pair: Placed) -> bool:
        """Whether both scans of a pair may be learnt from."""
        return not self.held_out & set(pair.ends)

    def overlapping(self, pair: Placed) -> Overlapping:
        """The clouds of a pair, centred, at its pose."""
        a, b = (self.store.prepared(n) for n in pair.ends)
        T = np.array(pair.T_target_source)
        T[:3, 3] += T[:3, :3] @ a.centre - b.centre
        return Overlapping(a.points, b.points, T, pair.edge)

    def make_views(self, number: int, show: Show) -> None:
        """The views of a round: registered pairs, those of earlier rounds too, and parts of single scans."""
        recipe, rng = self.recipe, np.random.default_rng((self.recipe.seed, number, 1))
        pairs = {p.ends: p for found in self.rounds for p in found.pairs if self.trains(p)}
        pairs |= {p.ends: p for p in self.labelled if self.trains(p)}
        ordered = [pairs[ends] for ends in sorted(pairs)]
        few = [ordered[i] for i in rng.permutation(len(ordered))[: recipe.pairs]]
        again = -(-recipe.pairs // len(few)) if few else 0  # a few pairs are looked at again, at other scales
        drawn_pairs = [p for _ in range(min(again, MOST_LOOKS)) for p in few][: recipe.pairs]
        usable = sorted({n for found in self.rounds for n in found.scans} - self.held_out)
        singles = [int(n) for n in rng.choice(usable, recipe.single)] if usable else []

        def of_pair(item: tuple[int, Placed]) -> Views | None:
            local = np.random.default_rng((recipe.seed, number, 2, item[0]))
            return drawn_views(self.overlapping(item[1]), local, recipe.patches, recipe.others)

        def of_single(item: tuple[int, int]) -> Views | None:
            local = np.random.default_rng((recipe.seed, number, 3, item[0]))
            parts = seen_twice(self.store.prepared(item[1]).points, local)
            if parts is None:
                return None
            return drawn_views(parts, local, recipe.patches, recipe.others, touch=False)

        def made(work: Any, items: list[Any], what: str) -> list[Views]:
            found = side_by_side(work, list(enumerate(items)), partial(show, what))
            return [views for views in found if views is not None]

        self.views["registered"] = made(of_pair, drawn_pairs, "patches of registered pairs")
        self.views["single"] = made(of_single, singles, "patches of single scans")
        if recipe.made_up and not self.views["made up"]:
            self.views["made up"] = make_material(
                recipe.made_up, recipe.patches, recipe.seed, partial(show, "procedural scans"), others=recipe.others
            )
        if not any(self.views.values()):
            raise TrainingError("the scans are too small to learn from: no part of one holds 500 points")
        if not self.tests:
            self.make_tests(show)

    def make_tests(self, show: Show) -> None:
        """What is tested after each epoch: the same pairs throughout."""
        recipe = self.recipe
        pairs = [p for found in self.rounds[:1] for p in found.pairs if not self.trains(p)]
        pairs = [p for p in [*pairs, *self.labelled] if not self.trains(p)]
        order = np.random.default_rng((recipe.seed, 4)).permutation(len(pairs))
        chosen = [self.overlapping(pairs[i]) for i in order[: recipe.tested]]
        if len(chosen) < FEWEST_TESTED:
            chosen += [parts for _, parts in self.cuts(recipe.tested - len(chosen))]
        made_up = [made_up_pair((recipe.seed, 5, n)) for n in range(TESTED_MADE_UP)]
        for name, some in ((SCANS, chosen), (MADE_UP, made_up)):
            look = partial(whole_views, count=TESTED_KEYPOINTS)
            found = side_by_side(look, some, partial(show, "what is held out"))
            self.tests[name] = [views for views in found if views is not None]

    def cuts(self, count: int) -> list[tuple[str, Overlapping]]:
        """Parts of held-out scans that stand in for pairs, the bands of overlap in turn; of one scan alone, its own."""
        numbers = sorted(self.held_out) or list(range(len(self.scans)))
        found: list[tuple[str, Overlapping]] = []
        for k in range(2 * count):
            rng, which = np.random.default_rng((self.recipe.seed, 6, k)), k % len(CUT_SHARES)
            try:
                points = self.store.prepared(numbers[k // len(CUT_SHARES) % len(numbers)]).points
            except FmrError:
                continue
            parts = seen_twice(points, rng, CUT_SHARES[which])
            if parts is not None and len(found) < count:
                found.append((list(BANDS)[which], parts))
        return found

    def parts(self) -> list[Part]:
        """The scans that stand in one frame by the last round, without those that are held out."""
        found = self.rounds[-1].parts if self.rounds else []
        parts = [{n: np.array(T) for n, T in part.items() if n not in self.held_out} for part in found]
        return [part for part in parts if part]

    def held_out_scans(self) -> list[Part]:
        """Those of the last round, each as a part of its own."""
        return [{n: np.eye(4)} for n in (self.rounds[-1].scans if self.rounds else []) if n in self.held_out]

    def held_out_pairs(self) -> list[Placed]:
        """The pairs with a scan that is held out."""
        placed = {p.ends: p for found in self.rounds for p in found.pairs if not self.trains(p)}
        return list((placed | {p.ends: p for p in self.labelled if not self.trains(p)}).values())


def held_out(count: int, share: float, seed: int) -> set[int]:
    """The scans that are never trained on, by number: none of one scan, else one at least and never all."""
    wanted = min(max(round(share * count), 1 if count < 5 else 2), count - 1)
    return {int(n) for n in np.random.default_rng((seed, 8)).permutation(count)[:wanted]}


def labelled_pairs(rows: list[tuple[Path, Path, np.ndarray]], scans: list[Scan], seed: int) -> list[Placed]:
    """Pairs of known pose as pairs of the scans, which hold their files. Raises FmrError where one cannot be read."""
    number = {scan.path: n for n, scan in enumerate(scans)}
    store = Store(scans, seed, None)
    found = []
    for source, target, T in rows:
        a, b = (store.prepared(number[path]) for path in (source, target))
        edge = pair_edge(a, b)
        moved = (a.points + a.centre) @ T[:3, :3].T + T[:3, 3] - b.centre
        shared = max(overlap(moved, b.points, 1.5 * edge))
        found.append(Placed(number[source], number[target], T.tolist(), shared, edge, True))
    return found


def read_rounds(path: Path) -> list[Found]:
    """The rounds in a run's folder. Raises ModelError where the file is no such thing."""
    if not path.is_file():
        return []
    try:
        return [Found.of(plain) for plain in json.loads(path.read_text())]
    except (ValueError, TypeError, KeyError) as error:
        raise ModelError(f"{path}: no rounds to resume ({error}); run without --resume in another --out") from None
