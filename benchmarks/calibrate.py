"""Calibrate the verdict: logistic regression on the evidence at right and wrong poses of made-up scans.

    python -m benchmarks.calibrate --pairs 1500 --out calibration/       # verdict.json: copy it to models/

Prints how often the poses of each confidence are right, each judged by weights that were fitted on other pairs; OUT
gets verdict.json and, where matplotlib is installed, calibration.png. The pairs are those of
``fmr_cli/synthetic/calibration_pairs.py``; no real scan is among them.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fmr_cli.evaluation.verdict import calibration_error
from fmr_cli.evaluation.verdict_evidence import Judged, decisive, gather
from fmr_cli.evaluation.verdict_fit import are_right, cross_validated, fit, judge
from fmr_cli.registration.confidence import (
    ALIGNED,
    BARE,
    CONTRADICTION,
    DETAIL,
    LACKING_MUCH,
    MISSING,
    OTHER_SCALE,
    SCANT,
    SHARE,
    STRETCH,
    detail_log,
    rivalled,
    standing,
)
from fmr_cli.registration.looks import COARSE, FINE, Look
from fmr_cli.registration.models import model
from fmr_cli.registration.verdict_weights import Weights
from fmr_cli.report.calibration import calibration_table, plot_calibration

LEAST = 8  # pairs: fewer leave a tenth of the curve empty; some hundred make weights


def bounds_in(evidence: Sequence[Judged], weights: Weights) -> list[str]:
    """How often right poses have what bounds the confidence, whatever the weights say (``confidence.confidences``)."""
    weigh = [standing(j.x, weights)[0] for j in evidence]
    first = [int(w.argmax()) for w in weigh]
    x, right = zip(*((j.x[i], j.right[i]) for j, i in zip(evidence, first, strict=True)), strict=True)
    seen, good = np.array(x), np.array(right)
    poses = np.concatenate([j.x[j.right] for j in evidence])
    stretched = -poses[:, STRETCH] > 100 * OTHER_SCALE
    said = [f"fits better by another scale: {stretched.sum()} of {len(poses)} right poses"]
    alike = np.array([rivalled(j.x, j.largest, w, weights) for j, w in zip(evidence, weigh, strict=True)])
    for name, holds in (
        ("more contradicted than explained", seen[:, CONTRADICTION] < 0),
        ("a third missing", seen[:, MISSING] < LACKING_MUCH),
        ("hardly anything explained", seen[:, SHARE] < np.log(SCANT)),
        ("hardly more than three planes", seen[:, DETAIL] < detail_log(BARE)),
        ("nothing stands out at a close rival", alike),
    ):
        said.append(f"{name}: {good[holds].sum()} of {holds.sum()} poses that stood first were right")
    return said


def decisions(evidence: Sequence[Judged], confidence: np.ndarray, best: np.ndarray) -> list[str]:
    """What ``align`` would say of the pairs, ending at one look each; confidence, best: as ``verdict_fit.judge``."""
    looks: dict[int, dict[Look, int]] = {}
    for i, j in enumerate(evidence):
        looks.setdefault(j.number, {})[j.look] = i
    ends = []
    for at in looks.values():
        said_of = {look: float(confidence[i]) for look, i in at.items()}
        ends.append((at, *decisive(said_of, {look: int(evidence[i].place[best[i]]) for look, i in at.items()})))
    where, said = np.array([at[look] for at, look, _ in ends]), np.array([p for *_, p in ends])
    aligned, good = said >= ALIGNED, are_right(evidence, best)[where]
    unique = np.array([evidence[i].unique for i in where])
    kinds = Counter(evidence[i].kind for i in where[aligned & ~good])
    named = "; ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    ended = Counter(look for _, look, _ in ends)
    return [
        f"{kinds.total()} of {aligned.sum()} aligned poses are wrong ({named or 'none'}), "
        f"{(aligned & good & unique).sum()} of {(good & unique).sum()} unique right ones are aligned, "
        f"expected calibration error {calibration_error(said, good):.3f}",
        "pairs by the look they end at: " + ", ".join(f"{look}: {ended[look]}" for look in (*COARSE, FINE)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=1500, help=f"of scans, at least {LEAST}")
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--workers", type=int, help="processes; the figures do not depend on it")
    parser.add_argument("--out", type=Path, default=Path("calibration"))
    args = parser.parse_args()
    if args.pairs < LEAST:
        parser.error(f"--pairs {args.pairs}: at least {LEAST} make a curve, and some hundred make weights")
    args.out.mkdir(exist_ok=True, parents=True)
    evidence = gather(args.pairs, args.seed, args.workers)
    confidence, best = cross_validated(evidence)
    right = are_right(evidence, best)
    print(f"{len(evidence)} looks at {args.pairs} pairs, each judged by weights fitted on others:")
    print(calibration_table(confidence, right))
    print(f"expected calibration error {calibration_error(confidence, right):.3f}")
    print("as align decides:", *decisions(evidence, confidence, best), sep="\n")
    print("by the bundled weights, which may have seen such pairs:")
    print(*decisions(evidence, *judge(evidence, model(None).verdict)), sep="\n")
    weights = fit(evidence)
    for line in bounds_in(evidence, weights):
        print(line)
    made = {"made by": f"python -m benchmarks.calibrate --pairs {args.pairs} --seed {args.seed}"}
    rounded = {name: [float(f"{v:.6g}") for v in values] for name, values in asdict(weights).items()}
    (args.out / "verdict.json").write_text(json.dumps(made | rounded, indent=1) + "\n")
    try:
        plot_calibration(args.out / "calibration.png", confidence, right)
    except ImportError as error:
        print(f"plot: skipped ({error})")


if __name__ == "__main__":
    main()
