"""Calibrate the verdict: logistic regression on the evidence at right and wrong poses of made-up scans.

    python -m benchmarks.calibrate --pairs 1500 --out calibration/       # verdict.json: copy it to models/

Prints how often the poses of each confidence are right, each judged by weights that were fitted on other pairs; OUT
gets verdict.json and, where matplotlib is installed, calibration.png. The pairs are those of
``fmr_cli/synthetic/calibration_pairs.py``; no real scan is among them.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from fmr_cli.evaluation.verdict_evidence import gather
from fmr_cli.evaluation.verdict_fit import cross_validated, fit
from fmr_cli.report.calibration import calibration_table, plot_calibration


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=1500, help="of scans, at least 50")
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--workers", type=int, help="processes; the figures do not depend on it")
    parser.add_argument("--out", type=Path, default=Path("calibration"))
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True, parents=True)
    evidence = gather(args.pairs, args.seed, args.workers)
    confidence, right = cross_validated(evidence)
    print(f"{len(evidence)} looks at {args.pairs} pairs, each judged by weights fitted on others:")
    print(calibration_table(confidence, right))
    made = {"made by": f"python -m benchmarks.calibrate --pairs {args.pairs} --seed {args.seed}"}
    weights = {name: [float(f"{v:.6g}") for v in values] for name, values in asdict(fit(evidence)).items()}
    (args.out / "verdict.json").write_text(json.dumps(made | weights, indent=1) + "\n")
    try:
        plot_calibration(args.out / "calibration.png", confidence, right)
    except ImportError as error:
        print(f"plot: skipped ({error})")


if __name__ == "__main__":
    main()
