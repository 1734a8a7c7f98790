"""How far the verdict can be trusted: made-up pairs that fool it or make it shy, through ``align``.

    python -m benchmarks.verdict --pairs 300 --seed 1 --out verdict.json
    python -m benchmarks.verdict --kinds repetition "mirrored room"

``right``: the mean displacement of the source's points from a right pose is below 1 % of the size (loose: 15 deg and
3 %). ``wrong``: ``aligned``, though the pose is not right or not the only one. NEES: the pose's error against its
covariance; 5.35 is the median expected of six directions. ``aliases``: the share of pairs that fit in several ways of
which the result names more than one.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from fmr_cli.evaluation.verdict import judge_many, reliability, report, summary
from fmr_cli.registration.result import plain
from fmr_cli.synthetic.verdict_pairs import FAMILIES, KINDS


def chosen(names: list[str]) -> list[str]:
    """The kinds of these names: a kind, a family, or the beginning of a kind's name."""
    found = [kind for name in names for kind in FAMILIES.get(name, [k for k in KINDS if k.startswith(name)])]
    if not found:
        raise SystemExit(f"no kind of pairs is called {', '.join(names)}; families: {', '.join(FAMILIES)}")
    return list(dict.fromkeys(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=300, help="in all, the kinds in turn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", default=list(FAMILIES), help="kinds or families")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--origins", action="store_true", help="tell align where the sensors were")
    parser.add_argument("--out", type=Path, help="everything as JSON")
    args = parser.parse_args()
    rows = []
    for row in judge_many(args.pairs, args.seed, chosen(args.kinds), args.workers, args.origins):
        rows.append(row)
        print(f"\r{len(rows)} of {args.pairs}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(report(rows))
    if args.out:
        curve, error = reliability(rows)
        said = {"seed": args.seed, "origins": args.origins, **summary(rows), "reliability": curve, "ece": error}
        args.out.write_text(json.dumps(plain({**said, "rows": [asdict(r) for r in rows]}), indent=1))


if __name__ == "__main__":
    main()
