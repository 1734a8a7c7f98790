"""All that registration has learnt goes on from the user's scans, without labels.

In rounds: the scans are registered with each other by what has been learnt so far; where two of them surely show one
place, their patches correspond. On these, on pairs made from single scans and on procedural ones the local encoder
learns (InfoNCE). A share of the steps is the global encoder's, by the paper's losses.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fmr_cli.errors import FmrError, ModelError
from fmr_cli.io.weights import Weights, weights_bytes
from fmr_cli.multiway.scans import Scan
from fmr_cli.multiway.store import Store
from fmr_cli.registration.models import model
from fmr_cli.registration.prepared import pair_edge
from fmr_cli.synthetic.sensors import overlap
from fmr_cli.training import check
from fmr_cli.training.global_task import SUCCESS, GlobalTask
from fmr_cli.training.local_task import LocalNet, described, info_nce
from fmr_cli.training.local_views import Views, make_material
from fmr_cli.training.processes import rank_and_world, wait_for_all
from fmr_cli.training.recipe import ScanRecipe
from fmr_cli.training.run_folder import MODEL, TrainingError, held
from fmr_cli.training.scan_views import (
    Overlapping,
    drawn_views,
    inlier_ratio,
    made_up_pair,
    seen_twice,
    whole_views,
)
from fmr_cli.training.self_registration import BANDS, Found, Placed, drawn, register_scans, side_by_side
from fmr_cli.training.task import Files, Scores, Show, Task, ramped_cosine

ROUNDS, CURRENT = "registered.json", "current.safetensors"
RIGHT = "right matches"  # column of metrics.csv: the share of the matches of two scans that are right
SCANS, MADE_UP = "held-out scans", "made-up scans"  # what is tested
FORGOTTEN = 0.15  # of the right matches on made-up scans, that may be lost
SHARES = {"registered": 0.6, "single": 0.15, "made up": 0.25}  # of a step's pairs, where there are all three
TESTED_KEYPOINTS = 600  # of each scan; all of them take twice the time
TESTED_MADE_UP = 6  # pairs
FEWEST_TESTED = 4  # held-out pairs; where there are fewer, parts of held-out scans stand in
CUT_SHARES = (0.2, 0.45, 0.75)  # of the surface, that two parts of a held-out scan share: one of each of BANDS
CHECK_SHARE = 0.2  # of the minutes, that the last test may take


class ScanTask(Task):
    """Trains on ``scans`` by ``recipe``, from the model file ``start`` (None: the bundled one).

    whole: the global encoder's task, or None where it stays as it is. labelled: pairs whose pose is known.
    """

    recipe: ScanRecipe
    measure, measured = f"share of {RIGHT}", "of the matches that two scans of one place have, those that are right"

    def __init__(
        self, recipe: ScanRecipe, scans: list[Scan], device: torch.device, start: Path | None, whole: GlobalTask | None,
        labelled: list[Placed] | None = None,
    ) -> None:  # fmt: skip
        self.recipe, self.scans, self.device, self.start, self.whole = recipe, scans, device, start, whole
        self.clouds, self.clip = 2 * recipe.batch, recipe.whole.clip
        self.labelled = labelled or []
        torch.manual_seed(recipe.seed)
        self.net = LocalNet().to(device)
        if recipe.start != "scratch":
            self.net.load_state_dict(local_start(start))
        self.modules: dict[str, nn.Module] = {"local": self.net, **(whole.modules if whole else {})}
        self.held_out = held_out(len(scans), recipe.held_out, recipe.seed)
        self.rounds: list[Found] = []
        self.store = Store(scans, recipe.seed, None)
        self.views: dict[str, list[Views]] = {name: [] for name in SHARES}
        self.tests: dict[str, list[Views]] = {}
        self.last_scores: Scores = {}
        named = f"{len(scans)} scan{'s' if len(scans) > 1 else ''}, {len(self.held_out)} of them held out"
        self.described = [named, *(whole.described if whole else [])]
        if self.labelled:
            self.described.append(f"{len(self.labelled)} pairs of known pose")

    # Material.

    def round_at(self, step: int, steps: int) -> int:
        """Which round a step belongs to."""
        return min(step * self.recipe.rounds // max(steps, 1), self.recipe.rounds - 1)

    def renewals(self) -> int:
        return self.recipe.rounds - len(self.rounds)

    def renew(self, step: int, steps: int, files: Files, show: Show) -> list[str]:
        """Registers the scans anew where a round begins; views of the round's pairs take the place of the last ones."""
        notes: list[str] = []
        while len(self.rounds) <= self.round_at(step, steps):
            found = self.registered(len(self.rounds), files, show)
            notes += [f"warning: {said}" for said in found.skipped if not self.rounds]
            self.rounds.append(found)
            notes.append(f"round {len(self.rounds)}: {found.said}")
        if notes:
            self.make_views(len(self.rounds) - 1, show)
        return notes

    def registered(self, number: int, files: Files, show: Show) -> Found:
        """What a round has found: from the run's folder, or by registering; by the first process for all."""
        path = files.path / ROUNDS
        known = read_rounds(path)
        rank, _ = rank_and_world()
        if rank == 0 and len(known) <= number:
            recipe = self.recipe
            chosen = drawn(len(self.scans), recipe.scans, np.random.default_rng((recipe.seed, number)))
            if len(chosen) < 2:
                found = Found([], chosen, "one scan: learning from parts of it", [])
            else:
                found = register_scans(
                    self.scans, chosen, self.current(number, files), 2 * recipe.pairs, recipe.seed + number,
                    lambda p: show(f"round {number + 1}: {p.stage}", p.done, p.total),
                )  # fmt: skip
            known = [*known, found]
            files.write(ROUNDS, json.dumps([f.plain() for f in known], indent=1) + "\n")
        wait_for_all()
        return read_rounds(path)[number]

    def current(self, number: int, files: Files) -> Path | None:
        """A file of what has been learnt so far; in the first round, what the run starts from."""
        if number == 0:
            return self.start
        files.write(CURRENT, weights_bytes(Weights(local=arrays(self.net.state_dict()))))
        return files.path / CURRENT

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
            return halved(drawn_views(self.overlapping(item[1]), local, recipe.patches, recipe.others))

        def of_single(item: tuple[int, int]) -> Views | None:
            local = np.random.default_rng((recipe.seed, number, 3, item[0]))
            parts = seen_twice(self.store.prepared(item[1]).points, local)
            return None if parts is None else halved(
                drawn_views(parts, local, recipe.patches, recipe.others, touch=False)
            )  # fmt: skip

        def made(work: Any, items: list[Any], what: str) -> list[Views]:
            found = side_by_side(work, list(enumerate(items)), partial(show, what))
            return [views for views in found if views is not None]

        self.views["registered"] = made(of_pair, drawn_pairs, "patches of registered pairs")
        self.views["single"] = made(of_single, singles, "patches of single scans")
        if recipe.made_up and not self.views["made up"]:
            material = make_material(
                recipe.made_up, recipe.patches, recipe.seed, partial(show, "procedural scans"), others=recipe.others
            )
            self.views["made up"] = [views.half() for views in material]
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
            self.tests[name] = [views.half() for views in found if views is not None]

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

    # Steps.

    def whole_step(self, step: int) -> bool:
        """Whether a step is the global encoder's."""
        every = self.recipe.whole_every
        return self.whole is not None and every > 0 and step % every == every - 1

    def losses(self, step: int, steps: int, generator: torch.Generator) -> dict[str, Tensor]:
        """InfoNCE of a batch of pairs of all kinds; or the losses of the global encoder."""
        recipe = self.recipe
        if self.whole is not None and self.whole_step(step):
            return self.whole.losses(step // recipe.whole_every, steps // recipe.whole_every, generator)
        there = {name: views for name, views in self.views.items() if views}
        shares = torch.tensor([SHARES[name] for name in there], device=self.device)
        kinds = torch.multinomial(shares, recipe.batch, replacement=True, generator=generator)
        chosen = []
        for kind in kinds.tolist():
            views = list(there.values())[kind]
            which = torch.randint(len(views), (1,), generator=generator, device=self.device)
            chosen.append(views[int(which)].to(self.device))
        pairs = zip(described(self.net, chosen), chosen, strict=True)
        each = [info_nce(a, b, v, recipe.temperature, recipe.apart) for (a, b), v in pairs]
        return {"info_nce": torch.stack(each).mean()}

    def rate(self, step: int, steps: int) -> float:
        """A ramped cosine each."""
        every = self.recipe.whole_every
        if self.whole is not None and self.whole_step(step):
            return self.whole.rate(step // every, steps // every)
        return ramped_cosine(step, 0, steps, self.recipe.learning_rate, ramp=RAMP)

    # Tests.

    @torch.no_grad()
    def test(self) -> Scores:
        """How many matches are right, of held-out scans and of made-up ones; the global encoder's own test."""
        scores = {}
        for name, views in self.tests.items():
            shares = []
            for v in views:
                [(a, b)] = described(self.net, [v.to(self.device)])
                shares.append(inlier_ratio(a.cpu().numpy(), b.cpu().numpy(), v))
            if shares:
                scores[name] = {RIGHT: float(np.mean(shares))}
        if self.whole is not None:
            scores |= self.whole.test()
        self.last_scores = scores
        return scores

    def quality(self, scores: Scores) -> tuple[float, ...]:
        """Right matches on held-out scans; nothing where too many on made-up ones are forgotten."""
        before = self.start_scores.get(MADE_UP, {}).get(RIGHT, 0.0)
        forgotten = MADE_UP in scores and scores[MADE_UP][RIGHT] < (1 - FORGOTTEN) * before
        return (0.0 if forgotten else scores.get(SCANS, scores[MADE_UP])[RIGHT],)

    def may_choose(self, step: int) -> bool:
        return True

    def weights(self) -> bytes:
        """The model file: both encoders, the global one as it was where it has got worse."""
        started = model(self.start).weights
        local = arrays(self.net.state_dict())
        if self.whole is None or not self.whole_is_better():
            return weights_bytes(Weights(**vars(started) | {"local": local, "decoder": started.decoder}))
        encoder, decoder = self.whole.encoder, self.whole.decoder
        return weights_bytes(
            Weights(
                encoder.hidden, encoder.feature_dim, encoder.arrays(),
                arrays(decoder.state_dict()) if decoder is not None else {}, local, started.verdict,
            )
        )  # fmt: skip

    def whole_is_better(self) -> bool:
        """Whether the global encoder is no worse than it was, on its own held-out crops."""
        assert self.whole is not None
        now = self.last_scores
        names = [name for name in now if SUCCESS in now[name]]
        started = {name: self.start_scores[name] for name in names}
        return self.whole.quality({n: now[n] for n in names}) >= self.whole.quality(started)

    def shown(self, scores: dict[str, float]) -> str:
        return f"{scores[RIGHT]:.3f}" if RIGHT in scores else self.whole.shown(scores) if self.whole else ""

    def gain(self, before: Scores, after: Scores) -> str:
        if MADE_UP not in before:
            return ""
        return f"on made-up scans {before[MADE_UP][RIGHT]:.3f} before, {after[MADE_UP][RIGHT]:.3f} now"

    def card(self) -> list[str]:
        recipe = self.recipe
        own = "started from " + ("nothing" if recipe.start == "scratch" else recipe.start)
        whole = "as it was" if self.whole is None else f"one step in {recipe.whole_every}, by the paper's Chamfer loss"
        return [
            "All that registration uses: `fmr align --model FILE`, and so `batch`, `sequence`, `multiway`.",
            "",
            f"- Local encoder: {sum(p.numel() for p in self.net.parameters())} parameters, {own}.",
            f"- Global encoder: {whole}.",
            f"- Data: {'; '.join(self.described)}; {recipe.made_up} pairs of procedural scans.",
            *(f"- Round {n}: {found.said}." for n, found in enumerate(self.rounds, 1)),
            f"- Loss: InfoNCE at temperature {recipe.temperature:g}, {recipe.batch} pairs a step.",
        ]

    # The check.

    def closing_seconds(self, minutes: float) -> float:
        return CHECK_SHARE * 60 * minutes if self.recipe.checked else 0.0

    def check(self, files: Files, seconds: float | None, show: Show) -> dict[str, Any] | None:
        """Held-out pairs registered by ``align`` before and after; what has got worse is not kept."""
        if not self.recipe.checked:
            return None
        placed = {p.ends: p for found in self.rounds for p in found.pairs if not self.trains(p)}
        placed |= {p.ends: p for p in self.labelled if not self.trains(p)}
        third = self.recipe.checked // 3
        pairs = check.of_scans(list(placed.values()), self.store, self.recipe.checked - third, self.recipe.seed)
        cuts = self.cuts(self.recipe.checked - third - len(pairs))
        pairs += check.of_clouds(cuts, "parts of held-out scans")
        made_up = [("part", made_up_pair((self.recipe.seed, 7, n))) for n in range(third)]
        pairs += check.of_clouds(made_up, MADE_UP)
        checked = check.compare(pairs, self.start, files.path / MODEL, seconds, partial(show, "before and after"))
        decision = check.decide(checked, files.path / MODEL, self.start)
        if decision.replaced is not None:
            files.write(MODEL, decision.replaced)
        return {"said": decision.said, "rows": check.rows(checked), "kept": decision.kept}


MOST_LOOKS = 4  # views of one pair in a round: more show the same
RAMP = 30  # steps over which the rate rises: Adam knows its second moments by then, and a run may be short


def halved(views: Views | None) -> Views | None:
    """The views as they are kept."""
    return None if views is None else views.half()


def arrays(tensors: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors as a model file takes them."""
    return {name: value.numpy() for name, value in held(tensors).items()}


def local_start(start: Path | None) -> dict[str, Tensor]:
    """The local encoder to start from. Raises ModelError."""
    local = model(start).weights.local or model().weights.local
    found = {name: torch.from_numpy(array) for name, array in local.items()}
    try:
        LocalNet().load_state_dict(found)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(f"{start}: the weights do not fit the local encoder ({reason})") from None
    return found


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
