"""The harness that judges the verdict: what it counts, and that it tells right from wrong."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import verdict as command
from fmr_cli.cloud import PointCloud
from fmr_cli.evaluation import verdict
from fmr_cli.evaluation.verdict import Judged, aliases_named, judge, nees, reliability, report, summary
from fmr_cli.geometry.motion import exp
from fmr_cli.registration.pipeline import align
from fmr_cli.synthetic.verdict_pairs import fresh_pair

ROW = Judged("copy", 0, True, False, True, True, "aligned", 0.9, 0.001, 1, 5.0, 6, 0.1)


def test_an_easy_pair_is_right_aligned_and_within_its_covariance() -> None:
    row = judge(fresh_pair("resample", 1, 0), 0)
    assert row.right
    assert row.loose
    assert row.aligned
    assert row.sound
    assert row.displacement < 0.01
    assert row.degrees == 6
    assert np.isfinite(row.nees)


def test_unrelated_scans_are_never_right() -> None:
    row = judge(fresh_pair("unrelated", 1, 0), 0)
    assert not row.right
    assert not row.loose
    assert row.displacement == np.inf


def test_what_align_refuses_is_a_row_that_says_why() -> None:
    pair = replace(fresh_pair("copy", 1, 0), source=np.zeros((50, 3)))
    row = judge(pair, 0)
    assert row.status == "failed"
    assert "one place" in row.message


def test_nees_of_errors_drawn_from_the_covariance_is_what_chi_square_says() -> None:
    rng = np.random.default_rng(0)
    root = np.diag([1e-4] * 3 + [2e-3] * 3) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    origin, truth = np.array([3.0, -40, 2]), exp(rng.normal(size=6))
    about, back = np.eye(4), np.eye(4)
    about[:3, 3], back[:3, 3] = origin, -origin
    found = SimpleNamespace(origin=origin, covariance=root @ root.T)
    drawn = []
    for _ in range(400):
        found.T_target_source = about @ exp(root @ rng.normal(size=6)) @ back @ truth
        error, degrees = nees(found, truth)  # type: ignore[arg-type]
        assert degrees == 6
        drawn.append(error)
    assert np.median(drawn) == pytest.approx(5.348, rel=0.15)  # the median of chi-squared with 6 degrees of freedom


def test_undetermined_directions_are_left_out_of_nees() -> None:
    found = SimpleNamespace(origin=np.zeros(3), covariance=np.diag([1e-4] * 3 + [1e-2, 1e-2, 0]))
    found.T_target_source = exp(np.array([0, 0, 0, 0.1, 0, 5.0]))
    error, degrees = nees(found, np.eye(4))  # type: ignore[arg-type]
    assert degrees == 5
    assert error == pytest.approx(1.0)


def test_aliases_count_once_each() -> None:
    pair = fresh_pair("table", 2, 0)
    other = [{"T_target_source": T.tolist()} for T in (*pair.poses, *pair.poses, np.eye(4))]
    found = SimpleNamespace(T_target_source=pair.poses[0], alternatives=other)
    assert aliases_named(pair, found) == len(pair.poses)  # type: ignore[arg-type]


def test_aligned_is_wrong_where_several_poses_fit_or_none() -> None:
    several = replace(ROW, kind="box", unique=False, several=True, aliases=2)
    rows = [ROW, replace(ROW, status="uncertain", confidence=0.3), several, replace(ROW, right=False, confidence=0.8)]
    s = summary(rows)
    assert (s["aligned"], s["aligned_wrong"], s["right"], s["unique"]) == (3, 2, 2, 3)
    assert s["precision"] == pytest.approx(1 / 3)
    assert s["recall"] == pytest.approx(0.5)
    assert s["aliases_named"] == 1
    assert "precision of aligned 0.333 (2 wrong of 3" in report(rows)


def test_reliability_of_honest_and_of_vain_confidence() -> None:
    honest = [replace(ROW, confidence=0.75, right=i % 4 > 0) for i in range(40)]
    curve, error = reliability(honest)
    assert error == pytest.approx(0)
    assert curve == [{"low": 0.7, "pairs": 40, "confidence": pytest.approx(0.75), "right": pytest.approx(0.75)}]
    assert reliability([replace(r, confidence=1.0) for r in honest])[1] == pytest.approx(0.25)


def test_right_is_judged_by_the_source_s_own_points() -> None:
    pair = fresh_pair("copy", 3, 0)
    T = pair.poses[0].copy()
    T[:3, 3] += 0.5 * verdict.RIGHT * pair.size * np.array([1, 0, 0])
    assert pair.is_right(T)
    T[:3, 3] += verdict.RIGHT * pair.size * np.array([1, 0, 0])
    assert not pair.is_right(T)
    assert pair.is_right(T, verdict.LOOSE_DEGREES, verdict.LOOSE)
    found = align(PointCloud(pair.source), PointCloud(pair.target))
    assert pair.is_right(found.T_target_source)


def test_the_command(tmp_path: Path, monkeypatch, capsys) -> None:
    def run(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["benchmarks.verdict", *arguments])
        command.main()

    run("--pairs", "3", "--kinds", "copy", "plane", "--workers", "1", "--out", str(tmp_path / "v.json"))
    assert "expected calibration error" in capsys.readouterr().out
    said = json.loads((tmp_path / "v.json").read_text())
    assert [row["kind"] for row in said["rows"]] == ["copy", "plane", "copy"]
    assert said["pairs"] == 3
    with pytest.raises(SystemExit) as end:
        run("--kinds", "teapot")
    assert end.value.code
    assert "no kind of pairs is called teapot" in f"{end.value.code}{capsys.readouterr().err}"
