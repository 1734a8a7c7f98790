"""The report of a pair: whole in one file, true to the result, harmless whatever names say, alive in a browser."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pages import MOST, Tags, data_of, numbers

from fmr_cli import PointCloud
from fmr_cli.cloud import transform_points
from fmr_cli.registration.confidence import Candidate, Evidence, doubts
from fmr_cli.report import words
from fmr_cli.report.page import plotly_js
from fmr_cli.report.pair_page import Target, write_pair
from fmr_cli.report.points import SHOWN

pytest.importorskip("jinja2")
pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def page(pair, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_pair(path, *pair)
    assert path.stat().st_size < MOST
    return path.read_text("utf-8")


def test_nothing_is_fetched(page):
    tags = Tags(page).tags
    assert not [tag for tag, _ in tags if tag in ("link", "iframe", "object", "embed", "base")]
    places = [value for _, a in tags for name, value in a.items() if name in ("src", "href", "action", "poster")]
    assert all(place.startswith(("#", "data:")) for place in places)
    policy = next(a["content"] for tag, a in tags if tag == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in policy
    assert "http" not in policy
    ours = page.replace(plotly_js(), "")
    assert not re.search(r"https?://", ours)
    assert "@import" not in ours


def test_the_poses_drawn_are_those_of_the_result(pair, page):
    source, target, found = pair
    data = data_of(page)
    assert [pose["name"] for pose in data["poses"]] == ["before", "result"]
    drawn = [numbers(cloud["points"], "<f4").reshape(-1, 3).astype(float) for cloud in data["clouds"]]
    assert len(drawn[1]) == min(len(source), SHOWN)
    moved = transform_points(np.array(data["poses"][1]["matrix"]), drawn[1]) + target.points.mean(0)
    expected = transform_points(found.T_target_source, source.points)
    order = [np.lexsort(np.round(x, 3).T) for x in (moved, expected)]
    np.testing.assert_allclose(moved[order[0]], expected[order[1]], atol=2e-3)
    before = transform_points(np.array(data["poses"][0]["matrix"]), drawn[1]) + target.points.mean(0)
    np.testing.assert_allclose(before.mean(0), source.points.mean(0), atol=1e-5)
    written = np.array([line.split() for line in data["poses"][1]["text"].splitlines()], float)
    np.testing.assert_array_equal(written, found.T_target_source)


def test_what_the_page_says(pair, page):
    _, _, found = pair
    text = re.sub(r"\s+", " ", page.replace(plotly_js(), ""))
    assert f"Confidence {found.confidence:.2f}" in text
    assert "aligned" in text
    for word in ("rotation", "Seconds by stage", "Versions", "All options", "numpy", "max_angle", *found.seconds):
        assert word in text


def test_reasons_alternatives_and_open_directions(doubtful, tmp_path):
    write_pair(tmp_path / "r.html", *doubtful)
    text = (tmp_path / "r.html").read_text("utf-8")
    data = data_of(text)
    assert [pose["name"] for pose in data["poses"]] == ["before", "result", "alternative 1", "alternative 2"]
    assert data["poses"][3]["words"] == "shifted by 1 along (1.00, 0.00, 0.00)"
    assert data["arrows"] == [{"kind": "shift", "vector": [1, 0, 0], "words": "shift along (1.00, 0.00, 0.00)"}]
    assert "wherever the source is" in text
    assert "▲ not determined" in text


@pytest.mark.parametrize(
    "name", ["<script>alert(1)</script>.ply", '"><img src=x onerror=alert(1)>.ply', "{{ 7*7 }}.ply"]
)
def test_a_name_is_only_a_name(pair, tmp_path, name):
    source, target, found = pair
    hostile = replace(source, path=Path(name), crs="</script><b>", layout="<i>x</i>")
    write_pair(tmp_path / "r.html", hostile, target, replace(found, warnings=[f"{name}: <b>bold</b>"]))
    text = (tmp_path / "r.html").read_text("utf-8")
    tags = [tag for tag, _ in Tags(text).tags]
    assert tags.count("script") == 5  # the data, plotly.js and three of ours
    assert not {"img", "i"} & set(tags)
    assert data_of(text)["clouds"][1]["file"] == name


def test_plane_errors_are_the_offset_between_two_planes():
    grid = np.stack([*np.meshgrid(np.arange(60.0), np.arange(60.0)), np.zeros((60, 60))], -1).reshape(-1, 3)
    target = Target(grid)
    assert target.spacing == 1
    assert target.noise == 0
    inner = grid[(np.abs(grid[:, :2] - 30) < 20).all(1)]
    at = target.residuals(inner + np.array([0.3, 0.4, 0.25]), 3.0)
    np.testing.assert_allclose(at.plane, 0.25, atol=1e-9)
    np.testing.assert_allclose(at.point, np.sqrt(0.25 + 0.0625), atol=1e-9)
    far = target.residuals(inner[:3] + np.array([0, 0, 9.0]), 3.0)
    assert np.isinf(far.point).all()
    assert np.isinf(far.plane).all()


def test_points_without_a_counterpart_anywhere(pair, tmp_path):
    """A pose that brings nothing near anything still gives a page."""
    source, target, found = pair
    T = np.eye(4)
    T[:3, 3] = 1e6
    write_pair(tmp_path / "r.html", source, target, replace(found, T_target_source=T, inlier_rmse=float("inf")))
    poses = data_of((tmp_path / "r.html").read_text("utf-8"))["poses"]
    assert poses[1]["errors"]["point"] == {"median": None, "rms": None}
    assert (numbers(poses[1]["point"], "<u2") == 65535).all()


def test_ten_points(tmp_path, pair):
    few = PointCloud(np.random.default_rng(0).random((10, 3)))
    write_pair(tmp_path / "r.html", few, few, replace(pair[2], T_target_source=np.eye(4)))
    assert len(numbers(data_of((tmp_path / "r.html").read_text("utf-8"))["clouds"][0]["points"], "<f4")) == 30


def test_every_doubt_of_the_verdict_comes_with_advice():
    evidence = Evidence(
        explained=10, contradicted=90, missing=60, largest=40, overlap=0.1, explained_share=0.01, inlier_rmse=1.0,
        offset=9.0, turn=9.0, detail=0, stretch=0.04, votes=1, repeats=0.0,
    )  # fmt: skip
    said = doubts(None, Candidate(np.eye(4), "features", [], evidence), [])  # type: ignore[arg-type]
    assert len(said) >= 4
    assert all(what for _, what in words.advice(said))
    lacking = replace(evidence, explained=1000, contradicted=60, missing=40)
    said = doubts(None, Candidate(np.eye(4), "features", [], lacking), [])  # type: ignore[arg-type]
    assert said[0] == "40 points that lie together are in one scan alone"
    assert all(what for _, what in words.advice(said))


def test_in_a_browser_a_section_moves_and_an_alternative_is_chosen(doubtful, tmp_path, opened):
    write_pair(tmp_path / "r.html", *doubtful)
    browser = opened(tmp_path / "r.html")
    x_of_source = "return Array.from(document.getElementById('section').data[1].x)"
    change = (
        "const e = document.querySelector(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('input'))"
    )
    settle = "requestAnimationFrame(() => requestAnimationFrame(() => arguments[arguments.length - 1]()))"
    first, said = browser.execute_script(x_of_source), browser.find_element("id", "section-said").text
    browser.execute_script(change, "#section-at", 620)
    browser.execute_async_script(settle)
    assert browser.find_element("id", "section-said").text != said
    second = browser.execute_script(x_of_source)
    assert second != first
    matrix = browser.find_element("id", "matrix-text").text
    browser.find_element("css selector", "input[name=pose][value='3']").click()
    browser.execute_async_script(settle)
    assert browser.find_element("id", "matrix-text").text.split() == doubtful_text(doubtful[2], 1).split()
    assert browser.find_element("id", "matrix-text").text != matrix
    assert browser.execute_script(x_of_source) != second
    assert "alternative 2" in browser.find_element("id", "pose-said").text
    assert len(browser.execute_script("return document.getElementById('scene').data")) == 3  # two clouds, an arrow
    browser.execute_script(change.replace("'input'", "'change'"), "#colouring", "plane")
    browser.find_element("id", "theme").click()
    browser.find_element("id", "theme").click()
    browser.execute_async_script(settle)
    ground = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert ground == "rgb(21, 24, 28)"


def doubtful_text(found, number: int) -> str:
    from fmr_cli.io import transform_text

    return transform_text(np.array(found.alternatives[number]["T_target_source"]))
