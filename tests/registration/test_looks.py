"""Looks at a pair: which one decides, and what is said where two of them disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmr_cli import PointCloud, align
from fmr_cli.registration import hypotheses, looks, pipeline, refinement
from fmr_cli.registration.confidence import ALIGNED, Judge, doubts
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.pipeline import prepare
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch

Scans = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def scans(room_scans: Scans) -> tuple[Prepared, Prepared]:
    source, target = (prepare(PointCloud(points[::3])) for points in room_scans)
    return source, target


def looked(scans: tuple[Prepared, Prepared], look: looks.Look, confidence: float, shift: float = 0.0) -> Judge:
    """A look at the scans whose one pose has that confidence, ``shift`` away from where they were taken."""
    judge = Judge(make_pair(*scans, Options(), 1, *look))
    T = judge.pair.enter_centred(np.eye(4))
    T[0, 3] += shift
    judge.consider(T, "features", [])
    judge.candidates = [replace(judge.best, confidence=confidence)]
    return judge


@pytest.mark.parametrize(
    ("shift", "reason"), [(0.0, "less speaks for it"), (1.0, "the scans fit better shifted by 1 along")]
)
def test_a_pose_that_fine_voxels_do_not_bear_out_is_given_with_a_doubt(
    scans: tuple[Prepared, Prepared], shift: float, reason: str
) -> None:
    coarse, fine = looked(scans, looks.CLOSER, 0.94), looked(scans, looks.FINE, 0.2, shift)
    judge = looks.disputed(coarse, fine)
    assert judge.best.T_target_source.tolist() == coarse.best.T_target_source.tolist()
    assert judge.best.confidence == looks.DISPUTED * 0.94 < ALIGNED
    assert doubts(judge.pair, judge.best, [])[0].startswith(f"on finer voxels {reason}")


def test_two_looks_at_one_pose_are_one_opinion_and_leave_the_others_less(scans: tuple[Prepared, Prepared]) -> None:
    close, fine = looked(scans, looks.CLOSER, 0.9), looked(scans, looks.FINE, 0.5)
    assert looks.same_best(close, fine)
    assert not looks.same_best(close, looked(scans, looks.FINE, 0.5, shift=1.0))
    fine.candidates.append(replace(fine.best, confidence=0.4))
    both = looks.together(close, fine)
    assert both.pair is fine.pair
    assert [c.confidence for c in both.candidates] == pytest.approx([0.75, 0.2])  # odds of 9 and 1: of 3


@pytest.mark.parametrize(("stands_out", "confidence"), [(True, 0.9), (False, 0.4737)])
def test_a_thing_that_tells_a_pose_from_its_rivals_makes_its_odds_ten_times_as_good(
    scans: tuple[Prepared, Prepared], stands_out: bool, confidence: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(looks, "stands_out", lambda judge: stands_out)
    judge = looked(scans, looks.CLOSER, 0.4737)  # odds of 0.9
    looks.tell_apart(judge, Stopwatch())
    assert judge.told == stands_out
    assert judge.best.confidence == pytest.approx(confidence, abs=1e-3)


def test_a_wide_look_is_refined_on_finer_voxels_and_others_on_their_own(scans: tuple[Prepared, Prepared]) -> None:
    closer = looked(scans, looks.CLOSER, 0.9)
    assert looks.finer(closer) is closer
    assert looks.finer(looked(scans, looks.WIDER, 0.9)).pair.edge == closer.pair.edge


@pytest.mark.parametrize(("points", "searched"), [(150, True), (6000, False)])
def test_the_global_feature_is_searched_by_default_where_points_are_few(
    points: int, searched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, asked = np.random.default_rng(3), []
    monkeypatch.setattr(hypotheses, "from_search", lambda pair: asked.append(pair) or [])
    source, target = (PointCloud(rng.uniform(-1, 1, (points, 3))) for _ in range(2))  # of one size, and unlike
    assert align(source, target, hints=False).status == "uncertain"
    assert bool(asked) == searched


@pytest.mark.parametrize(("points", "hopeless", "looked_at"), [(6000, 1.0, False), (6000, 0.0, True), (150, 1.0, True)])
def test_a_hopeless_pair_gets_no_fine_look_unless_its_points_are_few(
    points: int, hopeless: float, looked_at: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, asked, further = np.random.default_rng(5), [], looks.further
    monkeypatch.setattr(looks, "further", lambda *args, **given: asked.append(args) or further(*args, **given))
    monkeypatch.setattr(looks, "HOPELESS", hopeless)
    source, target = (PointCloud(rng.uniform(-1, 1, (points, 3))) for _ in range(2))
    assert align(source, target, hints=False).status == "uncertain"
    assert bool(asked) == looked_at


def test_what_a_look_on_the_same_voxels_found_is_taken_over_with_its_own_matches(
    scans: tuple[Prepared, Prepared],
) -> None:
    first, closer = looked(scans, looks.FIRST, 0.4), looked(scans, looks.CLOSER, 0.4)
    judge = Judge(closer.pair)
    judge.adopt(first.best)
    assert judge.best.evidence == closer.best.evidence
    assert judge.best.evidence.votes > first.best.evidence.votes


@pytest.mark.parametrize(("confidence", "known"), [(0.04, 0), (0.06, 1)])
def test_wide_voxels_are_asked_about_poses_that_are_not_hopeless(
    scans: tuple[Prepared, Prepared], confidence: float, known: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge, formers = looked(scans, looks.FIRST, confidence), []

    def look(pair: object, time: object, former: Judge | None = None) -> Judge:
        formers.append(former)
        return judge

    monkeypatch.setattr(looks, "coarse_look", look)
    looks.at_once(*scans, Options(), 1, Stopwatch())
    assert [former is judge for former in formers] == [False, True, bool(known)]


@pytest.mark.parametrize(("start", "polished"), [("features", 0), ("given", 1)])
def test_a_pose_without_hope_is_polished_only_where_it_was_given(
    scans: tuple[Prepared, Prepared], start: str, polished: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge, asked = looked(scans, looks.CLOSER, 0.04), []
    judge.candidates = [replace(judge.best, start=start)]
    monkeypatch.setattr(pipeline, "look", lambda *_: judge)
    monkeypatch.setattr(refinement, "by_geometry", lambda pair, T: asked.append(T) or refinement.Polished(T))
    assert pipeline.align(*scans, hints=False).status == "uncertain"
    assert len(asked) == polished


def test_a_score_is_told_as_none_only_where_it_is_below_what_is_asked_for(scans: tuple[Prepared, Prepared]) -> None:
    pair, T = make_pair(*scans, Options(), 1, *looks.FIRST), np.eye(4)
    told = 0
    for shift in np.linspace(0, 2, 30):
        T[0, 3] = shift
        given = pair.overlap_score(T, floor=0.3)
        plain = pair.overlap_score(T)
        assert given == plain or (given == 0 and plain < 0.3)
        told += given == 0
    assert 0 < told < 30
