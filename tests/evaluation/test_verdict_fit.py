"""The verdict's fit: answers that were drawn by known weights are judged truly, and evidence repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmr_cli.cloud import PointCloud
from fmr_cli.evaluation.verdict import calibration_error
from fmr_cli.evaluation.verdict_evidence import Judged, all_looks, decisive, number_of, pair_evidence
from fmr_cli.evaluation.verdict_fit import are_right, cross_validated, fit, judge
from fmr_cli.registration.confidence import ALIGNED, DETAIL, MISSING, QUALITY, SHARE, STRETCH, TOLD, most
from fmr_cli.registration.looks import CLOSER, DISPUTED, FINE, FIRST, SURE, WIDER, at_once
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import one_blas_thread
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch
from fmr_cli.report.calibration import calibration_table, plot_calibration
from fmr_cli.synthetic.calibration_pairs import DRAWN
from fmr_cli.synthetic.verdict_pairs import fresh_pair


@pytest.fixture(scope="module")
def drawn() -> list[Judged]:
    """1,500 looks at three poses each: the first fits best, and is right by a chance that its votes decide."""
    rng = np.random.default_rng(0)
    looks = []
    for number in range(1500):
        x = np.column_stack([np.ones(3), rng.normal(size=(3, 10))])
        x[0, QUALITY] += 4
        bounding = [SHARE, STRETCH, DETAIL]
        x[:, bounding] = np.abs(x[:, bounding])  # nothing that bounds a confidence by itself
        right = np.zeros(3, bool)
        right[0] = rng.random() < 1 / (1 + np.exp(-2 * x[0, 1]))
        looks.append(Judged(x, right, np.zeros(3), np.arange(3), np.zeros(3, bool), FIRST, "drawn", True, number))
    return looks


def test_confidence_is_the_share_that_is_right(drawn):
    confidence, best = cross_validated(drawn)
    right = are_right(drawn, best)
    assert len(confidence) == len(drawn)
    for low in (0.0, 0.25, 0.5, 0.75):
        here = (confidence >= low) & (confidence < low + 0.25)
        assert right[here].mean() == pytest.approx(confidence[here].mean(), abs=0.08)


def test_no_kind_counts_against_its_own_sense(drawn):
    against = [replace(j, x=j.x * [1, -1, *[1] * 9]) for j in drawn]
    assert fit(against).support[1] == 0


def test_what_is_missing_tells_among_rivals_alone(drawn):
    told = [replace(j, x=np.where(np.arange(11) == MISSING, 3.0 * j.right[:, None], j.x)) for j in drawn]
    weights = fit(told)
    assert weights.support[MISSING] == 0
    assert weights.fit[MISSING - QUALITY.start] > 0


def test_a_pose_that_a_thing_tells_from_its_rivals_is_believed_more(drawn):
    weights = fit(drawn)
    plain, best = judge(drawn, weights)
    raised, same = judge([replace(j, told=np.arange(3) == i) for j, i in zip(drawn, best, strict=True)], weights)
    assert (best == same).all()
    bound = [most(j.x[i]) for j, i in zip(drawn, best, strict=True)]
    assert raised == pytest.approx(np.minimum(TOLD * plain / (1 - plain + TOLD * plain), bound))


def test_the_table_counts_every_pair_and_its_right_ones():
    confidence, right = np.array([0.05, 0.8, 0.95, 1.0]), np.array([True, False, True, True])
    lines = calibration_table(confidence, right).splitlines()
    assert [int(line.split()[-2]) for line in lines[1:-1]] == [1, 0, 0, 0, 1, 1, 1]
    assert lines[-1] == "aligned: precision 0.6667, recall of right poses 0.6667"
    assert calibration_error(confidence, right) == pytest.approx((0.95 + 0.8 + 0.05 + 0) / 4)


def test_the_plot_is_a_png(tmp_path, drawn):
    pytest.importorskip("matplotlib")
    confidence, best = judge(drawn, fit(drawn))
    plot_calibration(tmp_path / "c.png", confidence, are_right(drawn, best))
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")


def test_a_pair_gives_the_same_evidence_every_time_and_one_of_its_poses_is_right():
    first, again = (pair_evidence((42_000, DRAWN.index("copy"))) for _ in range(2))
    assert [judged.look for judged in first] == [FIRST, CLOSER, WIDER, FINE]
    for a, b in zip(first, again, strict=True):
        assert (a.x == b.x).all()
        assert (a.right == b.right).all()
        assert a.right.any()


ONE_PLACE, TWO_PLACES = dict.fromkeys((FIRST, CLOSER, WIDER, FINE), 0), {FIRST: 0, CLOSER: 0, WIDER: 0, FINE: 1}


def test_the_first_look_that_is_sure_decides_and_a_wide_one_has_to_be_surer():
    said = {FIRST: 0.2, CLOSER: SURE, WIDER: 1.0, FINE: 1.0}
    assert decisive(said, ONE_PLACE) == (CLOSER, SURE)
    assert decisive(said | {FIRST: SURE}, ONE_PLACE) == (FIRST, SURE)
    assert decisive(said | {CLOSER: 0.9}, ONE_PLACE) == (WIDER, 1.0)
    assert decisive(said | {CLOSER: 0.9, WIDER: SURE}, ONE_PLACE) == (FINE, 1.0)


def test_fine_voxels_alone_decide_where_no_coarse_look_is_sure_of_its_pose():
    said = {FIRST: 0.1, CLOSER: 0.9, WIDER: 0.5}
    assert decisive(said | {FINE: ALIGNED}, TWO_PLACES) == (FINE, ALIGNED)
    assert decisive(said | {FINE: 0.5}, TWO_PLACES) == (FINE, 0.5)
    assert decisive(said | {FINE: 0.1}, TWO_PLACES) == (CLOSER, DISPUTED * 0.9)
    assert decisive({FIRST: 0.01, FINE: 0.3}, TWO_PLACES) == (FIRST, 0.01)  # hopeless
    assert decisive({FINE: 0.3}, TWO_PLACES) == (FINE, 0.3)


def test_of_a_pose_that_close_voxels_are_surer_of_than_fine_ones_both_have_a_say():
    said = {FIRST: 0.1, CLOSER: 0.9, WIDER: 0.95}
    assert decisive(said | {FINE: 0.5}, ONE_PLACE) == (FINE, pytest.approx(0.75))  # odds 9 and 1: 3
    assert decisive(said | {FINE: 0.94}, ONE_PLACE) == (FINE, 0.94)


@pytest.mark.parametrize("kind", ["copy", "facade", "seats", "object, 10 to 30 %", "facade, a door in both"])
def test_what_the_looks_decide_is_what_align_says(kind):
    pair = fresh_pair(kind, 42_000, 0)
    with one_blas_thread():
        source, target = Prepared(PointCloud(pair.source)), Prepared(PointCloud(pair.target))
        judges = {look: judge for look, judge in all_looks(source, target).items() if judge.candidates}
        judge = at_once(source, target, Options(), 1, Stopwatch())
    places: list[np.ndarray] = []
    place = {look: number_of(j.best.T_target_source, places, j.pair) for look, j in judges.items()}
    assert decisive({look: j.best.confidence for look, j in judges.items()}, place)[1] == judge.best.confidence
