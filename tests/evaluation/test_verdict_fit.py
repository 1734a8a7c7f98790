"""The verdict's fit: weights that generated the answers come back, and its evidence is the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli.evaluation.verdict_evidence import LOOKS, EvidenceTable, judged_candidates, pair_evidence
from fmr_cli.evaluation.verdict_fit import fit, fitted_half, judge
from fmr_cli.report.calibration import calibration_table, plot_calibration

WEIGHTS = np.array([-2.0, 1.5, 0.8])


@pytest.fixture(scope="module")
def drawn() -> EvidenceTable:
    """4,000 pairs of three poses each, whose right one (or none) is drawn by WEIGHTS; a fourth kind says nothing."""
    rng = np.random.default_rng(0)
    pairs = 4000
    x = np.concatenate([np.ones((pairs, 3, 1)), rng.normal(size=(pairs, 3, 3))], axis=2)
    odds = np.exp(x[..., :3] @ WEIGHTS)
    chances = np.concatenate([odds, np.ones((pairs, 1))], 1) / (1 + odds.sum(1, keepdims=True))
    choice = (chances.cumsum(1) > rng.random((pairs, 1))).argmax(1)
    right = choice[:, None] == np.arange(3)
    return EvidenceTable(x.reshape(-1, 4), right.ravel(), np.repeat(np.arange(pairs), 3))


def test_the_weights_that_made_the_answers_come_back(drawn):
    assert fit(drawn) == pytest.approx([*WEIGHTS, 0], abs=0.12)


def test_no_kind_counts_against_its_own_sense(drawn):
    against = EvidenceTable(drawn.x * [1, -1, 1, 1], drawn.right, drawn.pair)
    assert fit(against)[1] == 0


def test_confidence_is_the_share_that_is_right(drawn):
    confidence, right = judge(drawn, fit(drawn))
    assert len(confidence) == 4000
    for low in (0.2, 0.4, 0.6):
        here = (confidence >= low) & (confidence < low + 0.2)
        assert right[here].mean() == pytest.approx(confidence[here].mean(), abs=0.05)


def test_the_half_that_is_fitted_has_each_look_and_shares_no_pair():
    pair = np.arange(24)
    fitted = fitted_half(EvidenceTable(np.ones((24, 1)), np.ones(24, bool), pair))
    assert fitted.sum() == 12
    assert np.bincount(pair[fitted] % len(LOOKS)).tolist() == [4, 4, 4]


def test_the_table_counts_every_pair_and_its_right_ones():
    confidence, right = np.array([0.05, 0.8, 0.95, 1.0]), np.array([True, False, True, True])
    lines = calibration_table(confidence, right).splitlines()
    assert [int(line.split()[-2]) for line in lines[1:-1]] == [1, 0, 0, 0, 1, 1, 1]
    assert lines[-1] == "aligned: precision 0.6667, recall of right poses 0.6667"


def test_the_plot_is_a_png(tmp_path, drawn):
    pytest.importorskip("matplotlib")
    plot_calibration(tmp_path / "c.png", *judge(drawn, fit(drawn)))
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")


def test_evidence_survives_its_file(tmp_path, drawn):
    drawn.save(tmp_path / "e.npz")
    again = EvidenceTable.load(tmp_path / "e.npz")
    assert (again.x == drawn.x).all()
    assert (again.right == drawn.right).all()


def test_a_pair_gives_the_same_evidence_every_time():
    first, again = (pair_evidence((42_000, 0)) for _ in range(2))
    assert len(first) > 1
    assert all((a == b).all() and r == s for (a, r), (b, s) in zip(first, again, strict=True))


def test_one_of_the_candidates_of_a_plain_pair_is_right(room_scans):
    candidates, edge = judged_candidates(*room_scans, "features", seed=0)
    off = [np.linalg.norm(T[:3, 3]) / edge for T, _ in candidates]
    assert min(off) < 2
    assert all(evidence[0] == 1 and np.isfinite(evidence).all() for _, evidence in candidates)
