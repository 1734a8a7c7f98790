"""How far the verdict can be trusted: what ``align`` says of made-up pairs that fool it, kind by kind."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri  # of chi-squared; scipy.stats takes a second to import

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import FmrError
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import align
from fmr_cli.registration.result import Registration
from fmr_cli.synthetic.verdict_pairs import KINDS, VerdictPair, fresh_pair

RIGHT = 0.01  # mean displacement of the source's points, of the size
LOOSE_DEGREES, LOOSE = 15.0, 0.03
BINS = 10


@dataclass(frozen=True)
class Judged:
    """One pair as ``align`` judged it.

    right: the pose is one of those that are right; loose: by the wider bounds. several: more than one is.
    aliases: of those several, how many the result names (its pose and its alternatives). displacement: mean, over
    the size. nees: of a right pose, by the covariance; degrees: over how many directions. message: why it failed.
    """

    kind: str
    number: int
    unique: bool
    several: bool
    right: bool
    loose: bool
    status: str
    confidence: float
    displacement: float
    aliases: int
    nees: float
    degrees: int
    seconds: float
    message: str = ""

    @property
    def aligned(self) -> bool:
        return self.status == "aligned"

    @property
    def sound(self) -> bool:
        """Whether ``aligned`` may be said of it: one pose is right, and it is this."""
        return self.unique and self.right


def judge(pair: VerdictPair, number: int, origins: bool = False) -> Judged:
    """Align one pair and compare. origins: tell ``align`` where the sensors were, where they were anywhere."""
    source, target = PointCloud(pair.source), PointCloud(pair.target)
    if origins:
        source.sensor_origin, target.sensor_origin = pair.source_origin, pair.target_origin
    begin = time.perf_counter()
    try:
        found = align(source, target, Options(), threads=1, hints=False)
    except FmrError as error:
        took = time.perf_counter() - begin
        return Judged(
            pair.kind, number, pair.unique, len(pair.poses) > 1, False, False, "failed", 0.0, np.inf, 0, np.nan, 0,
            took, str(error),
        )  # fmt: skip
    took = time.perf_counter() - begin
    right = pair.is_right(found.T_target_source, share=RIGHT)
    squared, degrees = nees(found, pair.poses[0]) if right and pair.unique else (np.nan, 0)
    return Judged(
        pair.kind, number, pair.unique, len(pair.poses) > 1, right,
        pair.is_right(found.T_target_source, LOOSE_DEGREES, LOOSE), found.status, found.confidence,
        pair.displacement(found.T_target_source), aliases_named(pair, found), squared, degrees, took,
    )  # fmt: skip


def aliases_named(pair: VerdictPair, found: Registration) -> int:
    """How many right poses that differ the result names: its own, and its alternatives."""
    named: list[np.ndarray] = []
    for T in (found.T_target_source, *(np.array(other["T_target_source"]) for other in found.alternatives)):
        moved = transform_points(T, pair.probes)
        new = all(np.linalg.norm(moved - other, axis=1).mean() > RIGHT * pair.size for other in named)
        if new and pair.is_right(T, share=RIGHT):
            named.append(moved)
    return len(named)


def nees(found: Registration, T_target_source: np.ndarray) -> tuple[float, int]:
    """Normalised estimation error squared against the true pose, and over how many directions.

    The error is the twist (rotation, translation) in the target's frame about ``found.origin`` that takes the true
    pose to the one found, to first order. Directions without a covariance are undetermined, and left out.
    """
    E = found.T_target_source @ np.linalg.inv(T_target_source)
    twist = np.append(
        Rotation.from_matrix(E[:3, :3]).as_rotvec(), transform_points(E, found.origin[None])[0] - found.origin
    )
    # Radians and units compare once each is divided by its own spread.
    spread = np.sqrt(np.maximum(np.diag(found.covariance), 1e-300))
    values, vectors = np.linalg.eigh(found.covariance / np.outer(spread, spread))
    known = values > 1e-9 * values[-1]
    along = vectors[:, known].T @ (twist / spread)
    return float((along**2 / values[known]).sum()), int(known.sum())


def _judge_fresh(case: tuple[str, int], seed: int, origins: bool) -> Judged:
    kind, number = case
    return judge(fresh_pair(kind, seed, number), number, origins)


def judge_many(
    pairs: int, seed: int, kinds: Sequence[str] = KINDS, workers: int = 2, origins: bool = False
) -> Iterator[Judged]:
    """``pairs`` fresh pairs, the kinds in turn, in order as they are done."""
    cases = [(kinds[i % len(kinds)], i // len(kinds)) for i in range(pairs)]
    run = partial(_judge_fresh, seed=seed, origins=origins)
    if workers == 1:
        yield from map(run, cases)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(run, cases)


def calibration_error(confidence: np.ndarray, right: np.ndarray) -> float:
    """The expected calibration error: |confidence - share right| in BINS equal bins, by their looks; both (n,)."""
    number = bins_of(confidence)
    return float(sum(np.abs((confidence - right)[number == b].sum()) for b in range(BINS)) / len(confidence))


def bins_of(confidence: np.ndarray) -> np.ndarray:
    """Which of BINS equal bins each confidence (n,) lies in; 1 in the last."""
    return np.minimum((confidence * BINS).astype(int), BINS - 1)


def reliability(rows: Sequence[Judged]) -> tuple[list[dict[str, float]], float]:
    """The reliability curve in BINS equal bins of confidence, and the expected calibration error.

    A confidence is right where ``aligned`` may be said (``Judged.sound``): of a pair that fits in several ways, no pose
    deserves it.
    """
    confidence, sound = np.array([r.confidence for r in rows]), np.array([r.sound for r in rows], float)
    number, curve = bins_of(confidence), []
    for b in range(BINS):
        here = number == b
        if here.any():
            mean, share = float(confidence[here].mean()), float(sound[here].mean())
            curve.append({"low": b / BINS, "pairs": int(here.sum()), "confidence": mean, "right": share})
    return curve, calibration_error(confidence, sound)


def summary(rows: Iterable[Judged]) -> dict[str, object]:
    """Counts and shares of some pairs. precision: of ``aligned`` ones, the share of which that may be said.

    recall: the share ``aligned`` of those unique and right; right: the share right of the unique. nees: its median over
    unique, right pairs, as a multiple of the median expected of as many directions.
    """
    rows = list(rows)
    aligned, unique = [r for r in rows if r.aligned], [r for r in rows if r.unique]
    wrong = [r for r in aligned if not r.sound]
    right, several = [r for r in unique if r.right], [r for r in rows if r.several]
    known = [r for r in right if r.degrees]

    def share(part: Sequence[object], of: Sequence[object]) -> float:
        return len(part) / len(of) if of else float("nan")

    return {
        "pairs": len(rows),
        "unique": len(unique),
        "right": len(right),
        "loose": sum(r.loose for r in unique),
        "aligned": len(aligned),
        "aligned_wrong": len(wrong),
        "aligned_wrong_loose": sum(not (r.unique and r.loose) for r in aligned),
        "failed": sum(r.status == "failed" for r in rows),
        "precision": 1 - share(wrong, aligned),
        "recall": share([r for r in right if r.aligned], right),
        "aliases_named": share([r for r in several if r.aliases > 1], several),
        "nees": float(np.median([r.nees for r in known])) if known else float("nan"),
        "nees_over_expected": float(np.median([r.nees / chdtri(r.degrees, 0.5) for r in known]))
        if known
        else float("nan"),
        "seconds": float(np.median([r.seconds for r in rows])) if rows else float("nan"),
    }


def report(rows: Sequence[Judged]) -> str:
    """A line a kind, then all together and the reliability curve."""
    lines = [f"{'kind':38s} {'promise':8s} right  aligned  wrong  aliases    NEES  median s"]
    for kind in dict.fromkeys(r.kind for r in rows):
        own = [r for r in rows if r.kind == kind]
        s = summary(own)
        promise = "unique" if own[0].unique else "several" if any(r.several for r in own) else "none"
        hits = sum(r.right for r in own)
        named = f"{s['aliases_named']:7.2f}" if promise == "several" else "       "
        error = f"{s['nees']:7.2f}" if np.isfinite(float(str(s["nees"]))) else "       "
        lines.append(
            f"{kind:38s} {promise:8s} {hits:2d}/{len(own):<2d}  {s['aligned']:7d}  {s['aligned_wrong']:5d}"
            f"  {named} {error}  {s['seconds']:8.2f}"
        )
    s = summary(rows)
    curve, calibration = reliability(rows)
    lines += [
        "",
        f"precision of aligned {s['precision']:.3f} ({s['aligned_wrong']} wrong of {s['aligned']}; "
        f"{s['aligned_wrong_loose']} by the loose bound)",
        f"unique pairs: {s['right']} right of {s['unique']}; of the right ones aligned {s['recall']:.3f}",
        f"NEES of unique, right pairs: median {s['nees']:.2f}, {s['nees_over_expected']:.2f} of the expected; "
        f"failed {s['failed']}",
        "",
        "confidence   pairs   mean  right",
    ]
    lines += [
        f"{b['low']:.1f} to {b['low'] + 1 / BINS:.1f}  {b['pairs']:6d}  {b['confidence']:.3f}  {b['right']:.3f}"
        for b in curve
    ]
    lines.append(f"expected calibration error {calibration:.3f}")
    return "\n".join(lines)
