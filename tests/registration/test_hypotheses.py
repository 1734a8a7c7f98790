"""Where a scene repeats itself, the rivals of a pose are found from that pose alone."""

from __future__ import annotations

import numpy as np
import pytest

from fmr_cli import PointCloud
from fmr_cli.cloud import angle_degrees
from fmr_cli.registration import looks, refinement
from fmr_cli.registration.confidence import Judge
from fmr_cli.registration.hypotheses import Hypothesis, rivals
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair, make_pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Stopwatch


def box_like() -> np.ndarray:
    """A block with two knobs, the same turned by half about z."""
    rng = np.random.default_rng(0)
    sides = np.array([1.0, 0.6, 0.35])
    points = rng.uniform(-1, 1, (12_000, 3))
    points[np.arange(12_000), rng.choice(3, 12_000, p=(1 / sides) / (1 / sides).sum())] = rng.choice([-1, 1], 12_000)
    knob = rng.normal(size=(1500, 3))
    knob = 0.15 * knob / np.linalg.norm(knob, axis=1, keepdims=True) + [0.6, 0.3, 0.35]
    return np.concatenate([points * sides, knob, knob * [-1, -1, 1]])


def test_half_a_turn_is_found_as_a_rival_of_the_true_pose() -> None:
    points = box_like()
    pair = make_pair(Prepared(PointCloud(points[::2])), Prepared(PointCloud(points[1::2])), Options())
    found, repeats = rivals(pair, pair.enter_centred(np.eye(4)))
    assert repeats > 0.3
    turned = [angle_degrees(h.T_target_source) for h in found]
    assert any(abs(angle - 180) < 10 for angle in turned)


def test_a_half_turn_is_found_where_features_do_not_tell_of_it() -> None:
    """An egg of three axes: smooth, so that no features of its two halves are alike by more than chance."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12_000, 3))
    points *= np.array([1.0, 0.7, 0.45]) / np.linalg.norm(points, axis=1, keepdims=True)
    pair = make_pair(Prepared(PointCloud(points[::2])), Prepared(PointCloud(points[1::2])), Options())
    found = rivals(pair, pair.enter_centred(np.eye(4)))[0]
    for axis in np.eye(3):
        turned = [h for h in found if angle_degrees(h.T_target_source @ half_turn(axis)) < 10]
        assert max(h.score for h in turned) > 0.9 * pair.overlap_score(np.eye(4))


def half_turn(axis: np.ndarray) -> np.ndarray:
    """(4, 4), about an axis (3,) of length 1 through the origin."""
    T = np.eye(4)
    T[:3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
    return T


def test_a_pose_that_a_refinement_has_spoilt_is_not_known() -> None:
    points = box_like()
    pair = make_pair(Prepared(PointCloud(points[::2])), Prepared(PointCloud(points[1::2])), Options())
    judge, truth, beside = Judge(pair), pair.enter_centred(np.eye(4)), np.eye(4)
    beside[:3, 3] = 2 * pair.edge
    judge.consider(beside @ truth, "features", [])
    assert not judge.knows(truth)
    judge.consider(truth, "features", [])
    assert judge.knows(beside @ truth)
    assert len(judge.candidates) == 1


def test_rivals_of_a_pose_are_sought_once(monkeypatch: pytest.MonkeyPatch) -> None:
    points = box_like()
    pair = make_pair(Prepared(PointCloud(points[::2])), Prepared(PointCloud(points[1::2])), Options())
    judge, sought = Judge(pair), []

    def counted(pair: Pair, T_target_source: np.ndarray) -> tuple[list[Hypothesis], float]:
        sought.append(T_target_source)
        return rivals(pair, T_target_source)

    monkeypatch.setattr(looks.hypotheses, "rivals", counted)
    looks.consider(judge, looks.features(pair, Stopwatch()), Stopwatch())
    before = judge.candidates
    looks.consider(judge, looks.features(pair, Stopwatch()), Stopwatch())
    assert len(sought) == 1
    assert [c.confidence for c in judge.candidates] == [c.confidence for c in before]


def test_what_hardly_overlaps_beside_a_known_pose_is_not_judged() -> None:
    points = box_like()
    pair = make_pair(Prepared(PointCloud(points[::2])), Prepared(PointCloud(points[1::2])), Options())
    far, judge = np.eye(4), Judge(pair)
    far[:3, 3] = [1.0, 0.7, 0.4]
    poor = Hypothesis(far, "features", pair.overlap_score(far))
    leads_to = refinement.roughly(pair, [poor])[0].score
    looks.consider(judge, [poor], Stopwatch(), known=leads_to / 0.39)
    assert judge.candidates == []
    looks.consider(judge, [poor], Stopwatch(), known=leads_to / 0.41)
    assert len(judge.candidates) == 1
