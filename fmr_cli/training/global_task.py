"""The encoder of whole clouds: anchors first, then the paper's losses on clouds and pairs drawn anew in every step."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from fmr_cli.evaluation.heldout import HARD, score
from fmr_cli.feature_metric.decoder import Decoder, chamfer
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.synthetic.batches import (
    Augment,
    Pairs,
    draw_clouds,
    draw_pairs,
    make_pairs,
    random_motions,
    random_rotations,
)
from fmr_cli.training.losses import anchor_loss, draw_anchors, encode, pose_loss
from fmr_cli.training.recipe import Recipe
from fmr_cli.training.task import Scores, Task, ramped_cosine
from fmr_cli.training.weights import encoder_bytes, load_weights

ANCHOR_POINTS = 2048  # points of a step that the anchors' loss is a mean over
DECODER_RATE = 1e-3  # learning rate of a new decoder alone, Adam's default: there is nothing yet to unlearn
TEST_POINTS = 512  # of each cloud in the held-out test, as many as in the tables of models/README.md
LOST = 30.0  # degrees: a registration that is further off counts as that far, so that a mean says something
SUCCESS, MEDIAN, MEAN = "success", "median deg", "mean deg, at most 30"  # columns of metrics.csv

Start = tuple[Encoder, dict[str, Tensor]]


@dataclass
class Data:
    """Clouds (S, M, 3), normalised, on the training device. pairs: labelled sources and targets (S, M, 3), or None."""

    train: Tensor
    held_out: Tensor
    pairs: tuple[Tensor, Tensor] | None = None
    described: list[str] = field(default_factory=list)  # for the card


def read_start(name: str) -> Start | None:
    """The weights to start from: "scratch" is None, "base" the bundled ones, else a file. Raises ModelError."""
    from fmr_cli.registration.models import bundled_path

    if name == "scratch":
        return None
    if name == "base":
        with bundled_path() as path:
            return load_weights(path)
    return load_weights(Path(name))


class GlobalTask(Task):
    """Trains ``Encoder`` on ``data`` by ``recipe``, from the weights of ``start`` or, where it is None, from nothing.

    warm is the first step in which the paper's losses may change the encoder.
    """

    recipe: Recipe
    measure, measured = "held-out success", "below 5 deg (median)"

    def __init__(self, recipe: Recipe, data: Data, start: Start | None) -> None:
        self.recipe, self.data, self.device = recipe, data, data.train.device
        self.described, self.clip = data.described, recipe.clip
        torch.manual_seed(recipe.seed)
        self.encoder, decoder_weights = start or (Encoder(recipe.feature_dim, recipe.hidden), {})
        self.encoder.requires_grad_(True).train().to(self.device)
        self.anchors = draw_anchors(self.encoder.feature_dim, torch.Generator(self.device).manual_seed(recipe.seed))
        self.warm = recipe.anchor_steps
        self.decoder = None
        if recipe.chamfer_weight > 0:
            self.decoder = Decoder(self.encoder.feature_dim, recipe.points).to(self.device)
            try:
                self.decoder.load_state_dict(decoder_weights)
            except RuntimeError:  # none in the file, or for another number of points: a new one
                self.warm += recipe.decoder_warmup if start is not None or recipe.anchor_steps else 0
        self.modules: dict[str, nn.Module] = {"encoder": self.encoder}
        if self.decoder is not None:
            self.modules["decoder"] = self.decoder
        with_chamfer, with_pose = recipe.chamfer_weight > 0, recipe.pose_weight > 0
        self.clouds = with_chamfer * recipe.chamfer_batch + with_pose * recipe.pose_batch

    def losses(self, step: int, steps: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Anchors in their steps; then Chamfer, and the pose error once the encoder may change."""
        recipe = self.recipe
        if step < recipe.anchor_steps:
            return {"anchors": anchor_loss(self.encoder, self.anchors, recipe.anchor_width, ANCHOR_POINTS, generator)}
        share = (step - recipe.anchor_steps) / max(steps - recipe.anchor_steps, 1)
        losses = {}
        if self.decoder is not None and share <= recipe.chamfer_until:
            losses["chamfer"] = self.chamfer_loss(self.decoder, generator, with_encoder=step >= self.warm)
        if recipe.pose_weight > 0 and step >= self.warm and share >= recipe.pose_after:
            losses["pose"] = self.pose_loss(generator)
        return losses

    def chamfer_loss(self, decoder: Decoder, generator: torch.Generator, with_encoder: bool) -> Tensor:
        """What the decoder makes of F of some points, against other points of the same cloud."""
        recipe = self.recipe
        clouds = draw_clouds(self.data.train, recipe.chamfer_batch, generator)
        seen, whole = clouds[:, : recipe.points], clouds[:, -recipe.points :]
        with torch.set_grad_enabled(with_encoder):
            code = encode(self.encoder, seen).feature
        return recipe.chamfer_weight * chamfer(decoder(code), whole).mean()

    def pose_loss(self, generator: torch.Generator) -> Tensor:
        """The point error of the unrolled iteration, the paper's plain one on whole pairs in a share of the steps."""
        recipe = self.recipe
        plain = float(torch.rand((), generator=generator, device=self.device)) < recipe.plain
        full = replace(recipe.augment, rotation=recipe.plain_rotation, overlap=1.0)
        pairs = self.draw(full if plain else recipe.augment, generator)
        error = pose_loss(self.encoder, pairs.source, pairs.target, pairs.truth, recipe.unroll, not plain)
        return recipe.pose_weight * error

    def draw(self, augment: Augment, generator: torch.Generator) -> Pairs:
        """The pairs of a step: synthetic ones, and every other step labelled ones where there are any."""
        recipe = self.recipe
        if self.data.pairs is None or float(torch.rand((), generator=generator, device=self.device)) < 0.5:
            return draw_pairs(self.data.train, recipe.pose_batch, recipe.points, augment, generator)
        sources, targets = self.data.pairs
        index = torch.randint(len(sources), (recipe.pose_batch,), generator=generator, device=self.device)
        turn = random_rotations(recipe.pose_batch, generator)
        order = torch.rand(sources.shape[1], generator=generator, device=self.device).argsort()[: recipe.points]
        source, target = ((x[index][:, order] @ turn) for x in (sources, targets))
        spread = torch.rand(3, recipe.pose_batch, generator=generator, device=self.device)
        truth = random_motions(augment.rotation * spread[0], augment.shift * spread[1], generator)
        sigma = augment.noise * spread[2].square()
        return make_pairs(source, target, truth, sigma, augment.centre, 0 * sigma, generator)

    def rate(self, step: int, steps: int) -> float:
        """A ramped cosine for the anchors, then one for the steps that are left."""
        if step < self.recipe.anchor_steps:
            return ramped_cosine(step, 0, self.recipe.anchor_steps, self.recipe.anchor_rate)
        if step < self.warm:
            return DECODER_RATE
        return ramped_cosine(step, self.warm, steps, self.recipe.learning_rate)

    def test(self) -> Scores:
        """Registers held-out clouds at every setting of HARD."""
        found = score(self.encoder, self.data.held_out, HARD, self.recipe.held_out_pairs, TEST_POINTS)
        return {
            name: {SUCCESS: e.success, MEDIAN: e.median, MEAN: float(np.minimum(e.rotation, LOST).mean())}
            for name, e in found.items()
        }

    def quality(self, scores: Scores) -> tuple[float, ...]:
        """Mean success over the settings, then the mean error."""
        success, error = (float(np.mean([s[what] for s in scores.values()])) for what in (SUCCESS, MEAN))
        return success, -error

    def may_choose(self, step: int) -> bool:
        """Not while anchors are learnt: the paper's losses are yet to come."""
        return step > self.recipe.anchor_steps

    def weights(self) -> bytes:
        return encoder_bytes(self.encoder, self.decoder)

    def shown(self, scores: dict[str, float]) -> str:
        return f"{scores[SUCCESS]:.2f} ({scores[MEDIAN]:.2f} deg)"

    def gain(self, before: Scores, after: Scores) -> str:
        (_, off), (_, now) = self.quality(before), self.quality(after)
        return f"mean error, at most {LOST:g} each: {-off:.2f} deg before, {-now:.2f} now"

    def card(self) -> list[str]:
        recipe, augment = self.recipe, self.recipe.augment
        losses = [
            *([f"{recipe.anchor_steps} steps of distances to anchors"] if recipe.anchor_steps else []),
            *(["Chamfer distance through the decoder"] if recipe.chamfer_weight else []),
            *([f"point error through {recipe.unroll} unrolled IC iterations"] if recipe.pose_weight else []),
        ]
        pairs = (
            f"rotation up to {augment.rotation:g} deg, shift up to {augment.shift:g}, noise up to {augment.noise:g}, "
            f"overlap down to {augment.overlap:.0%}, density down to {augment.density:.0%}"
        )
        widths = "-".join(map(str, (3, *self.encoder.hidden, self.encoder.feature_dim)))
        return [
            "The encoder of whole clouds, for `fmr align --model FILE`.",
            "",
            f"- Encoder: {widths}, started from {recipe.start}.",
            f"- Data: {'; '.join(self.described)}.",
            f"- Losses: {'; '.join(losses)}.",
            *([f"- Pairs: {pairs}."] if recipe.pose_weight else []),
            f"- Tested by {recipe.held_out_pairs} held-out registrations a setting: share below 5 deg, and median "
            f"error, from the identity, 10 iterations, robust steps, {TEST_POINTS} points, sampled apart.",
        ]
