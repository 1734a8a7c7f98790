"""Calibrate the verdict: logistic regression on the evidence at right and wrong poses of procedural scans.

    python -m benchmarks.calibrate --pairs 400 --out calibration/

Prints the weights for ``fmr_cli/registration/confidence.py``, and how often the poses of each confidence are right, on
the half of the pairs that was not fitted; OUT gets evidence.npz and, where matplotlib is installed, calibration.png.
The pairs are those of ``fmr_cli/synthetic/calibration_pairs.py``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from fmr_cli.evaluation.verdict_evidence import gather
from fmr_cli.evaluation.verdict_fit import fit, fitted_half, judge
from fmr_cli.report.calibration import calibration_table, plot_calibration


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=400, help="of scans, at least 6")
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--workers", type=int, help="processes; the figures do not depend on it")
    parser.add_argument("--out", type=Path, default=Path("calibration"))
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True, parents=True)
    evidence = gather(args.pairs, args.seed, args.workers)
    evidence.save(args.out / "evidence.npz")
    fitted = fitted_half(evidence)
    confidence, right = judge(evidence.of(~fitted), fit(evidence.of(fitted)))
    share = evidence.right.mean()
    print(
        f"{len(evidence.right)} poses of {args.pairs} pairs, {share:.3f} of them right; judged on the half not fitted:"
    )
    print(calibration_table(confidence, right))
    print("WEIGHTS, fitted on all:", np.round(fit(evidence), 3).tolist())
    try:
        plot_calibration(args.out / "calibration.png", confidence, right)
    except ImportError as error:
        print(f"plot: skipped ({error})")


if __name__ == "__main__":
    main()
