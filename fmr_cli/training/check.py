"""What a run has gained, as its user will see it: held-out pairs through ``align``, before and after.

A model by which more pairs are lost than won is not kept, in all or, of one kind, by more than chance (one deviation of
a fair coin); nor is one that calls more wrong poses ``aligned``, beyond chance. Where the confidence no longer holds on
these pairs, it is brought in line.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from fmr_cli.cloud import PointCloud, angle_degrees, transform_points
from fmr_cli.errors import FmrError
from fmr_cli.evaluation.verdict_evidence import RIGHT_DEGREES, RIGHT_SHARE
from fmr_cli.io.weights import weights_bytes
from fmr_cli.multiway.store import Store
from fmr_cli.registration import Options, align, prepare
from fmr_cli.registration.confidence import ALIGNED, SURE_LOGIT
from fmr_cli.registration.looks import FINE
from fmr_cli.registration.models import model
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.verdict_weights import Weights
from fmr_cli.training.scan_views import Overlapping
from fmr_cli.training.self_registration import BANDS, Placed, side_by_side

REGISTERED = "held-out scans"
LEAST = 4  # pairs that are checked, however little time there is
ENOUGH = 20  # pairs from which the confidence is compared with what is right
DEVIATIONS = 2.0  # by which its mean may differ from the share that is right
PRIOR = 0.25, 1.0  # deviations of the slope from 1 and of the offset from 0 that are expected, of log odds

Ends = Callable[[], tuple[Prepared, Prepared]]


@dataclass(frozen=True)
class CheckPair:
    """A pair whose pose is known. kind: of what; band: of BANDS; T_target_source in the clouds' own coordinates."""

    kind: str
    band: str
    ends: Ends
    T_target_source: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """What ``align`` has made of a pair. logit: of its confidence; determined: no direction is left open.

    degrees: off the known pose; matches: the share of the matches that are right there.
    """

    right: bool
    aligned: bool
    logit: float
    determined: bool
    degrees: float
    matches: float


@dataclass(frozen=True)
class Checked:
    """A pair before and after."""

    kind: str
    band: str
    before: Outcome
    after: Outcome


@dataclass(frozen=True)
class Decision:
    """Whether the model is kept; the file that takes its place, or None; why, in words."""

    kept: bool
    replaced: bytes | None
    said: list[str]


def of_scans(placed: list[Placed], store: Store, count: int, seed: int) -> list[CheckPair]:
    """At most ``count`` of the pairs, the bands of overlap in turn."""
    order = np.random.default_rng((seed, 9)).permutation(len(placed))
    rows = [[placed[i] for i in order if placed[i].band == name] for name in BANDS]
    chosen = [row[turn] for turn in range(count) for row in rows if turn < len(row)][:count]
    return [CheckPair(REGISTERED, p.band, partial(of_store, store, p), np.array(p.T_target_source)) for p in chosen]


def of_store(store: Store, pair: Placed) -> tuple[Prepared, Prepared]:
    """Both scans of a pair, made ready."""
    return store.prepared(pair.source), store.prepared(pair.target)


def in_memory(pair: Overlapping) -> tuple[Prepared, Prepared]:
    """Both clouds of a pair, made ready."""
    return prepare(PointCloud(pair.source)), prepare(PointCloud(pair.target))


def of_clouds(pairs: list[tuple[str, Overlapping]], kind: str) -> list[CheckPair]:
    """Pairs that are in memory, each with its band of overlap."""
    return [CheckPair(kind, name, partial(in_memory, p), p.T_target_source) for name, p in pairs]


def compare(
    pairs: list[CheckPair], before: Path | None, after: Path, seconds: float, show: Callable[[int, int], None]
) -> list[Checked]:
    """Registers the pairs by both models, kinds and bands in turn, as many as ``seconds`` allow."""
    begin = time.monotonic()
    ordered, a, b = in_turn(pairs), model(before), model(after)
    same = a.local.key == b.local.key and not b.weights.sites and all(
        np.array_equal(x, y) for x, y in zip(a.whole.layers[-1], b.whole.layers[-1], strict=True)
    )  # fmt: skip

    def one(item: tuple[int, CheckPair]) -> Checked | None:
        number, pair = item
        if number >= LEAST and time.monotonic() - begin > seconds:
            return None
        try:
            ends = pair.ends()
            first = outcome(ends, pair.T_target_source, Options(model=before))
            second = first if same else outcome(ends, pair.T_target_source, Options(model=after))
        except FmrError:
            return None
        return Checked(pair.kind, pair.band, first, second)

    return [found for found in side_by_side(one, list(enumerate(ordered)), show) if found is not None]


def in_turn(pairs: list[CheckPair]) -> list[CheckPair]:
    """The pairs so that any first part of them holds all kinds and bands."""
    groups: dict[tuple[str, str], list[CheckPair]] = {}
    for pair in pairs:
        groups.setdefault((pair.kind, pair.band), []).append(pair)
    rows = list(groups.values())
    return [row[turn] for turn in range(max(map(len, rows), default=0)) for row in rows if turn < len(row)]


def outcome(ends: tuple[Prepared, Prepared], truth: np.ndarray, options: Options) -> Outcome:
    """What ``align`` makes of a pair whose pose is known."""
    source, target = ends
    found = align(source, target, options, threads=1, hints=False)
    points = source.frame.leave(source.points[:: max(len(source.points) // 1000, 1)])
    off = np.linalg.norm(transform_points(found.T_target_source, points) - transform_points(truth, points), axis=1)
    degrees = angle_degrees(np.linalg.inv(truth) @ found.T_target_source)
    size = float(np.ptp(target.points, axis=0).max())
    pair = make_pair(source, target, options, 1, *FINE)
    matches = pair.inlier_count(pair.enter_centred(truth)) / max(len(pair.matches[0]), 1)
    p = min(max(found.confidence, 1e-9), 1 - 1e-9)
    right = degrees <= RIGHT_DEGREES and off.mean() < RIGHT_SHARE * size
    return Outcome(bool(right), found.status == "aligned", float(np.log(p / (1 - p))), not found.undetermined,
                   float(degrees), matches)  # fmt: skip


def decide(checked: list[Checked], path: Path, start: Path | None) -> Decision:
    """Whether the model in ``path`` is worth keeping, and its verdict brought in line where it has to be."""
    weights, said, replaced = model(path).verdict, [], None
    if not holds([c.after for c in checked]) or more_wrong(checked):
        slope, offset = in_line([c.after for c in checked])
        checked[:] = [replace(c, after=moved(c.after, slope, offset)) for c in checked]
        own = replace(weights, verdict=slope * weights.verdict)
        own.verdict[0] += offset
        replaced = weights_bytes(replace(model(path).weights, verdict=plain(own)))
        said.append(
            f"the verdict is brought in line with {len(checked)} held-out pairs (log odds times {slope:.2f}, "
            f"{offset:+.2f})"
        )
    elif checked:
        said.append(f"the verdict's confidence holds on {len(checked)} held-out pairs")
    why = ""
    all_won, all_lost = won_and_lost(checked)
    for name, some in groups(checked).items():
        won, lost = won_and_lost(some)
        if beyond_chance(lost, won) or (lost > won and all_lost > all_won):
            why = why or f"of {name}, {lost} pairs that were right no longer are, and {won} have come to be"
    if more_wrong(checked):
        why = why or "more wrong poses are called aligned than before"
    if why:
        # What is seen of sites is no weight, and stays unless it may be what deceives.
        sites = model(start).weights.sites if more_wrong(checked) else model(path).weights.sites
        kept = replace(model(start).weights, sites=sites)
        also = ", and what was seen of sites" if sites else ""
        return Decision(False, weights_bytes(kept), [f"not kept: {why}; {path} holds the start{also}"])
    return Decision(True, replaced, said)


def beyond_chance(more: int, less: int) -> bool:
    """Whether so many more are more than a fair coin gives."""
    return bool(more - less > np.sqrt(more + less))


def more_wrong(checked: list[Checked]) -> bool:
    """Whether more wrong poses are called aligned than before, beyond chance."""
    wrong = [tuple(o.aligned and not o.right for o in (c.before, c.after)) for c in checked]
    return beyond_chance(wrong.count((False, True)), wrong.count((True, False)))


def won_and_lost(checked: list[Checked]) -> tuple[int, int]:
    """How many pairs were won, and how many lost."""
    won = sum(c.after.right and not c.before.right for c in checked)
    return won, sum(c.before.right and not c.after.right for c in checked)


def groups(checked: list[Checked]) -> dict[str, list[Checked]]:
    """The pairs by what they are of."""
    return {kind: [c for c in checked if c.kind == kind] for kind in dict.fromkeys(c.kind for c in checked)}


def wrong_ones(outcomes: Any) -> int:
    """How many are called aligned and are not right."""
    return sum(o.aligned and not o.right for o in outcomes)


def holds(outcomes: list[Outcome]) -> bool:
    """Whether the mean confidence is the share that is right, as far as so few pairs can tell."""
    if len(outcomes) < ENOUGH:
        return True
    p = sigmoid(np.array([o.logit for o in outcomes]))
    right = np.array([o.right for o in outcomes])
    deviation = np.sqrt(max(float((p * (1 - p)).sum()), 0.25))
    return bool(abs(float(p.sum()) - right.sum()) <= DEVIATIONS * deviation)


def in_line(outcomes: list[Outcome]) -> tuple[float, float]:
    """Slope and offset of the log odds by which what is right is most likely (Platt), near 1 and 0 on few pairs."""
    logit = np.clip([o.logit for o in outcomes], -SURE_LOGIT, SURE_LOGIT)
    right = np.array([o.right for o in outcomes])

    def loss(w: np.ndarray) -> float:
        z = w[0] * logit + w[1]
        prior = ((w[0] - 1) / PRIOR[0]) ** 2 + (w[1] / PRIOR[1]) ** 2
        return float(np.logaddexp(0, np.where(right, -z, z)).sum() + prior / 2)

    found = minimize(loss, [1.0, 0.0], method="L-BFGS-B", bounds=[(0.1, 3.0), (-6.0, 6.0)]).x
    return float(found[0]), float(found[1])


def moved(o: Outcome, slope: float, offset: float) -> Outcome:
    """The outcome under log odds that are brought in line."""
    logit = slope * o.logit + offset
    return replace(o, logit=logit, aligned=bool(o.determined and sigmoid(np.array(logit)) >= ALIGNED))


def sigmoid(logit: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(logit, -SURE_LOGIT, SURE_LOGIT)))


def plain(weights: Weights) -> dict[str, Any]:
    """As ``models/verdict.json`` has them."""
    return {"made by": "fmr train"} | {name: np.asarray(value).tolist() for name, value in asdict(weights).items()}


def rows(checked: list[Checked]) -> list[dict[str, Any]]:
    """Counts and means of each kind and band: what the table, the card and the plot show."""
    found = []
    for kind, some in groups(checked).items():
        for name in BANDS if kind != "made-up scans" else ("",):
            here = [c for c in some if not name or c.band == name]
            if here:
                found.append({"kind": kind, "overlap": name, "pairs": len(here), **counts(here)})
    return found


def counts(here: list[Checked]) -> dict[str, Any]:
    """Before and after, of some pairs: how many right, aligned, wrong and aligned; right matches; median error."""
    both: dict[str, Any] = {}
    for when in ("before", "after"):
        some = [getattr(c, when) for c in here]
        right = [o.degrees for o in some if o.right]
        both[when] = {
            "right": sum(o.right for o in some),
            "aligned": sum(o.aligned for o in some),
            "wrong": wrong_ones(some),
            "matches": float(np.mean([o.matches for o in some])),
            "degrees": float(np.median(right)) if right else None,
        }
    return both
