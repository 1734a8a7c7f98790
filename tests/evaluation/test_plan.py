"""What `fmr evaluate` measures is the same whoever does it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fmr_cli.evaluation import plan
from fmr_cli.evaluation.experiments import EXPERIMENTS
from fmr_cli.evaluation.plan import Compared, OnDataset, OnScans
from fmr_cli.workers import Here, Processes
from fmr_cli.workers.base import LostError, UnfitError

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.fixture
def pairs(tmp_path) -> Path:
    """A CSV of three pairs, of which the second has no target."""
    a, b, truth = (SAMPLES / name for name in ("scan_a.ply", "scan_b.ply", "truth.txt"))
    path = tmp_path / "pairs.csv"
    path.write_text(f"source,target,transform\n{a},{b},{truth}\n{a},{tmp_path}/no.ply,{truth}\n{a},{b},{truth}\n")
    return path


def without_seconds(rows):
    return [replace(row, seconds=0.0) for several in rows for row in several]


@pytest.mark.slow
def test_a_data_set_by_this_process_and_by_two_others(pairs):
    made = OnDataset("pairs", (pairs,), Compared(align=False, plain=False))
    here, there = (without_seconds(made.run(team)) for team in (Here(), Processes(2)))
    assert [row.status for row in here] == ["", "failed", ""]
    assert repr(here) == repr(there)


@pytest.mark.slow
def test_an_experiment_by_this_process_and_by_two_others():
    made = OnScans((SAMPLES,), Compared(align=False), None, pairs=2, points=64)
    here, there = (without_seconds(made.run(EXPERIMENTS["noise"], team)) for team in (Here(), Processes(2)))
    assert [row.level for row in here] == [level for level, _ in EXPERIMENTS["noise"].levels for _ in range(2)]
    assert here == there


def test_a_lost_pair_is_a_row_and_a_worker_without_the_data_unfit(pairs, tmp_path):
    class Losing(Here):
        def run(self, function, tasks):
            for number in tasks:
                yield LostError("died") if number == 1 else function(number)

    made = OnDataset("pairs", (pairs,), Compared(align=False, plain=False))
    assert [row.message for several in made.run(Losing()) for row in several] == ["", "died", ""]
    elsewhere = OnDataset("pairs", (tmp_path / "nowhere.csv",), Compared())
    with pytest.raises(UnfitError, match="nowhere"):
        elsewhere.outcomes(0)
    assert plan.absolute([Path("x")])[0].is_absolute()
