"""What is kept: not what loses pairs, nor what is surer of wrong ones; a verdict that no longer holds is moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmr_cli.io import read_cloud
from fmr_cli.io.weights import weights_bytes
from fmr_cli.registration import prepare
from fmr_cli.registration.models import model
from fmr_cli.training.check import Checked, CheckPair, Outcome, compare, decide, holds, in_line, in_turn, rows


def outcome(right: bool, logit: float = 3.0) -> Outcome:
    return Outcome(right, logit > 1, logit, True, 1.0 if right else 90.0, 0.2)


def checked(*pairs: tuple[bool, bool], kind: str = "held-out scans") -> list[Checked]:
    return [Checked(kind, "small", outcome(a, 3.0 if a else -3), outcome(b, 3.0 if b else -3)) for a, b in pairs]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "model.safetensors").write_bytes(weights_bytes(model().weights))
    return tmp_path / "model.safetensors"


def test_what_wins_pairs_is_kept(path):
    decision = decide(checked((True, True), (False, True)), path, None)
    assert decision.kept
    assert decision.replaced is None


@pytest.mark.parametrize("kind", ["held-out scans", "made-up scans"])
def test_what_loses_pairs_is_not_kept(path, kind):
    some = [
        *checked((True, True), (False, True)),
        *checked((True, False), kind=kind),
        *checked((True, False), kind=kind),
    ]
    decision = decide(some, path, None)
    assert not decision.kept
    assert decision.replaced == weights_bytes(model().weights)
    assert kind in decision.said[0]


def test_one_made_up_pair_that_is_lost_is_chance_where_scans_win(path):
    won = checked((False, True), (False, True), (True, True))
    assert decide([*won, *checked((True, False), (True, True), kind="made-up scans")], path, None).kept
    assert not decide([*won, *checked((True, False), (True, False), kind="made-up scans")], path, None).kept


def test_a_verdict_that_is_too_sure_is_brought_in_line(path):
    before = outcome(False, -3)
    some = [Checked("held-out scans", "part", before, outcome(k % 3 > 0, 1.5)) for k in range(30)]
    assert not holds([c.after for c in some] * 3)
    decision = decide(some, path, None)
    assert "brought in line" in " ".join(decision.said)
    assert decision.kept
    path.write_bytes(decision.replaced)
    assert model(path).verdict.verdict[0] < model().verdict.verdict[0]
    assert np.array_equal(model(path).local.head[0][0], model().local.head[0][0])


def test_a_model_that_stays_sure_of_wrong_poses_is_not_kept(path):
    wrong = Checked("held-out scans", "part", outcome(False, -3), outcome(False, 9.0))
    sure = checked(*[(True, True)] * 30)
    decision = decide([*sure, wrong, wrong], path, None)
    assert not decision.kept
    assert "wrong poses" in decision.said[0]
    assert decide([*sure, wrong], path, None).kept  # one by chance, as of lost pairs


def test_confidence_that_holds_moves_little():
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, 400)
    some = [outcome(bool(rng.random() < 1 / (1 + np.exp(-z))), z) for z in logits]
    slope, offset = in_line(some)
    assert slope == pytest.approx(1, abs=0.25)
    assert offset == pytest.approx(0, abs=0.35)
    assert holds(some)


def test_pairs_are_registered_before_and_after(path):
    samples = Path(__file__).parents[2] / "samples"
    ends = tuple(prepare(read_cloud(samples / name)) for name in ("scan_a.ply", "scan_b.ply"))
    truth = np.loadtxt(samples / "truth.txt")
    pair = CheckPair("held-out scans", "much", lambda: ends, truth)
    [one] = compare([pair], None, path, np.inf, lambda done, total: None)
    assert one.before.right
    assert one.before == one.after  # the same weights
    assert one.after.matches > 0
    [row] = rows([one])
    assert (row["pairs"], row["after"]["right"], row["after"]["wrong"]) == (1, 1, 0)
    some = [CheckPair("a", "much", lambda: ends, truth)] * 3 + [CheckPair("b", "", lambda: ends, truth)]
    assert [p.kind for p in in_turn(some)] == ["a", "b", "a", "a"]
