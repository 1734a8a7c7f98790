"""All that registration has learnt goes on from the user's scans, without labels.

In rounds: the scans are registered with each other by what has been learnt so far; where two of them surely show one
place, their patches correspond. On these, on pairs made from single scans and on procedural ones the local encoder
learns (InfoNCE). A share of the steps is the global encoder's, by the paper's losses.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fmr_cli.descriptors.patch_encoder import LocalEncoder
from fmr_cli.io.weights import Weights, weights_bytes
from fmr_cli.multiway.scans import Scan
from fmr_cli.registration.models import model
from fmr_cli.training import check
from fmr_cli.training.global_task import SUCCESS, GlobalTask
from fmr_cli.training.local_task import LocalNet, described, info_nce, local_start
from fmr_cli.training.local_views import some_points
from fmr_cli.training.recipe import ScanRecipe
from fmr_cli.training.run_folder import MODEL, held
from fmr_cli.training.scan_material import MADE_UP, SCANS, SHARES, ScanMaterial
from fmr_cli.training.scan_views import inlier_ratio, made_up_pair
from fmr_cli.training.self_registration import Placed
from fmr_cli.training.sites import Part, Sites
from fmr_cli.training.task import Files, Scores, Show, Task, ramped_cosine

CURRENT = "current.safetensors"
RIGHT = "right matches"  # column of metrics.csv: the share of the matches of two scans that are right
FORGOTTEN = 0.15  # of the right matches on made-up scans, that may be lost
CHECK_SHARE = 0.3  # of the minutes, that making sites and the last test may take
SITES_SHARE, COMPARED_SHARE = 0.4, 0.9  # of these, after which no more scans are sought on sites, or pairs registered
ROUNDS_SHARE = 0.3  # of the time that is left after the first round, that further ones may take
RAMP = 30  # steps over which the rate rises: Adam knows its second moments by then, and a run may be short


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
        self.recipe, self.device, self.start, self.whole = recipe, device, start, whole
        self.clouds, self.clip = 2 * recipe.batch, recipe.whole.clip
        torch.manual_seed(recipe.seed)
        self.first = {} if recipe.start == "scratch" else local_start(start)
        self.net = (LocalNet.of(self.first) if self.first else LocalNet()).to(device)
        self.modules: dict[str, nn.Module] = {"local": self.net, **(whole.modules if whole else {})}
        self.material = ScanMaterial(recipe, scans, labelled or [])
        self.described = [*self.material.described(), *(whole.described if whole else [])]
        self.last_scores: Scores = {}

    def renewals(self) -> int:
        return self.material.renewals()

    def fit_renewals(self, seconds: float, each: float) -> dict[str, int]:
        """As many more rounds as fit into a share of the seconds: without steps before it, one finds nothing new."""
        more = int(ROUNDS_SHARE * seconds / each) if each > 0 else self.renewals()
        self.recipe = self.recipe.changed(rounds=len(self.material.rounds) + min(more, self.renewals()))
        self.material.recipe = self.recipe
        return {"rounds": self.recipe.rounds}

    def renew(self, step: int, steps: int, files: Files, show: Show) -> list[str]:
        """A round's material, where one begins."""
        return self.material.renew(step, steps, partial(self.current, files), files, show)

    def current(self, files: Files, number: int) -> Path | None:
        """A file of what has been learnt so far; in the first round, what the run starts from."""
        if number == 0:
            return self.start
        files.write(CURRENT, weights_bytes(Weights(local=self.learnt())))
        return files.path / CURRENT

    def learnt(self) -> dict[str, np.ndarray]:
        """The local encoder as it is tested and kept: between what it started from and where the steps have led.

        A mean of both weights keeps most of what is new and forgets little (Wortsman et al., CVPR 2022, "WiSE-FT").
        """
        now, new = arrays(self.net.state_dict()), np.float32(1 - self.recipe.stays)
        first = {name: value.numpy() for name, value in self.first.items()}
        return {name: first[name] + new * (now[name] - first[name]) for name in first} or now

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
        there = {name: views for name, views in self.material.views.items() if views}
        shares = torch.tensor([SHARES[name] for name in there], device=self.device)
        kinds = torch.multinomial(shares, recipe.batch, replacement=True, generator=generator)
        chosen = []
        for kind in kinds.tolist():
            views = list(there.values())[kind]
            which = torch.randint(len(views), (1,), generator=generator, device=self.device)
            seen = some_points(recipe.patch_points, generator)
            chosen.append(views[int(which)].sparser(seen).to(self.device))
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
        scores, encoder = {}, LocalEncoder.of(self.learnt())  # as ``align`` has it, and faster
        for name, views in self.material.tests.items():
            shares = [
                inlier_ratio(encoder(v.source.float().numpy()), encoder(v.target.float().numpy()), v) for v in views
            ]
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
        weights = replace(model(self.start).weights, local=self.learnt())
        if self.whole is not None and self.whole_is_better():
            encoder, decoder = self.whole.encoder, self.whole.decoder
            weights = replace(
                weights, hidden=encoder.hidden, feature_dim=encoder.feature_dim, layers=encoder.arrays(),
                decoder=arrays(decoder.state_dict()) if decoder is not None else {},
            )  # fmt: skip
        return weights_bytes(weights)

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
            *(f"- Round {n}: {found.said}." for n, found in enumerate(self.material.rounds, 1)),
            f"- Loss: InfoNCE at temperature {recipe.temperature:g}, {recipe.batch} pairs a step.",
        ]

    # The check.

    def closing_seconds(self, minutes: float) -> float:
        return CHECK_SHARE * 60 * minutes if self.recipe.checked else 0.0

    def check(self, files: Files, seconds: float | None, show: Show) -> dict[str, Any] | None:
        """What was seen of sites goes into the model; held-out pairs through ``align``, before and after.

        What has got worse is not kept. Once all is measured, what held-out scans show of the sites is kept as well.
        """
        begin, path = time.monotonic(), files.path / MODEL

        def left(share: float) -> float:
            return float("inf") if seconds is None else share * seconds - (time.monotonic() - begin)

        makes = Sites(self.material.store, path, lambda: left(SITES_SHARE) < 0, show)
        sites = makes.learn(self.material.parts()) if self.recipe.site_points else []
        said = self.keep_sites(files, makes, sites)
        checked = self.compared(files, left(COMPARED_SHARE), show) if self.recipe.checked else None
        if sites and model(path).weights.sites:
            makes = replace(makes, late=lambda: left(1.0) < 0)
            sites, _ = makes.grown(sites, self.material.held_out_scans())
            said = self.keep_sites(files, makes, sites)
        if checked is None:
            return {"said": said, "rows": [], "kept": True} if said else None
        return checked | {"said": [*said, *checked["said"]]}

    def compared(self, files: Files, seconds: float, show: Show) -> dict[str, Any]:
        """Held-out pairs registered by ``align`` before and after; what has got worse is not kept."""
        third, material = self.recipe.checked // 3, self.material
        placed = material.held_out_pairs()
        pairs = check.of_scans(placed, material.store, self.recipe.checked - third, self.recipe.seed)
        cuts = material.cuts(self.recipe.checked - third - len(pairs))
        pairs += check.of_clouds(cuts, "parts of held-out scans")
        made_up = [("part", made_up_pair((self.recipe.seed, 7, n))) for n in range(third)]
        pairs += check.of_clouds(made_up, MADE_UP)
        checked = check.compare(pairs, self.start, files.path / MODEL, seconds, partial(show, "before and after"))
        decision = check.decide(checked, files.path / MODEL, self.start)
        if decision.replaced is not None:
            files.write(MODEL, decision.replaced)
        return {"said": decision.said, "rows": check.rows(checked), "kept": decision.kept}

    def keep_sites(self, files: Files, makes: Sites, sites: list[Part]) -> list[str]:
        """Puts what scans show of sites into the model file; says so."""
        if not sites:
            return []
        path = files.path / MODEL
        points = [makes.points(site, self.recipe.site_points // len(sites)) for site in sites]
        files.write(MODEL, weights_bytes(replace(model(path).weights, sites=points)))
        scans, several = sum(map(len, sites)), f"{len(sites)} sites" if len(sites) > 1 else "a site"
        return [f"the model keeps {sum(map(len, points)):,} points of {several} that {scans} scans show"]


def arrays(tensors: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors as a model file takes them."""
    return {name: value.numpy() for name, value in held(tensors).items()}
