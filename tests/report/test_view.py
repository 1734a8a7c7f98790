"""What `fmr view` shows: poses of runs, colours, sections, a picture, a page."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pages import data_of, numbers

from fmr_cli import PointCloud, write_cloud, write_transform
from fmr_cli.errors import FmrError
from fmr_cli.report import view_window
from fmr_cli.report.coloring import HUES, RAMP, colors, missing, with_residuals
from fmr_cli.report.view_clouds import Section, load, read_section

BOX = np.random.default_rng(0).random((500, 3)) * [4, 3, 2]


@pytest.fixture
def files(tmp_path):
    """Two files, the second 10 units off along x."""
    dark = np.zeros(500, np.uint8)
    write_cloud(tmp_path / "a.ply", PointCloud(BOX, {"red": dark + np.uint8(255), "green": dark, "blue": dark}))
    write_cloud(tmp_path / "b.ply", PointCloud(BOX + np.array([10.0, 0, 0]), {"intensity": np.arange(500.0)}))
    return [tmp_path / "a.ply", tmp_path / "b.ply"]


def shift(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_a_transform_moves_the_first_file(files, tmp_path):
    write_transform(tmp_path / "T.txt", shift(10))
    clouds, notes = load(files, tmp_path / "T.txt", None, 10_000)
    np.testing.assert_allclose(clouds[0].points, clouds[1].points, atol=1e-6)
    assert not notes


def test_the_poses_of_a_network(files, tmp_path):
    scans = [{"file": str(files[0]), "component": 0, "T_component_scan": shift(10).tolist(), "name": "a"},
             {"file": str(files[1]), "component": 0, "T_component_scan": shift(0).tolist(), "name": "b"},
             {"file": "c.ply", "component": None, "T_component_scan": None, "name": "c"}]  # fmt: skip
    (tmp_path / "network.json").write_text(json.dumps({"scans": scans}))
    clouds, notes = load([], None, tmp_path, 10_000)
    np.testing.assert_allclose(clouds[0].points, clouds[1].points, atol=1e-6)
    assert notes == ["in other frames, not shown: c"]
    alone, _ = load(files[1:], None, tmp_path, 10_000)
    assert [c.path for c in alone] == files[1:]
    with pytest.raises(FmrError, match=r"T\.txt: is not among the scans of"):
        load([tmp_path / "T.txt"], None, tmp_path, 10_000)


@pytest.mark.parametrize("text", ["[]", "{", '{"scans": [1]}'])
def test_what_is_no_network(files, tmp_path, text):
    (tmp_path / "network.json").write_text(text)
    with pytest.raises(FmrError, match=r"network\.json: is not what fmr multiway writes"):
        load([], None, tmp_path, 10_000)


def test_the_pair_of_a_batch(files, tmp_path):
    with pytest.raises(FmrError, match=r"holds neither network\.json"):
        load(files, None, tmp_path, 10_000)
    write_transform(tmp_path / "T.txt", shift(10))
    (tmp_path / "results.csv").write_text("source,target,status,transform\na.ply,b.ply,aligned,T.txt\n")
    clouds, _ = load(files, None, tmp_path, 10_000)
    np.testing.assert_allclose(clouds[0].points, clouds[1].points, atol=1e-6)
    with pytest.raises(FmrError, match=r"no transform of b\.ply onto a\.ply"):
        load(files[::-1], None, tmp_path, 10_000)
    with pytest.raises(FmrError, match="one pair is shown"):
        load(files[:1], None, tmp_path, 10_000)


def test_sections(files):
    clouds, _ = load(files, None, None, 10_000)
    cut = read_section("z=1.5:0.2", clouds)
    assert cut == Section(2, 1.5, 0.2)
    assert (np.abs(BOX[cut.keep(BOX)][:, 2] - 1.5) <= 0.1).all()
    assert read_section("X", clouds).axis == 0
    assert read_section(None, clouds) is None
    for text in ("w=1", "z=high", "z=1:0", "=1", "z=nan", ""):
        with pytest.raises(FmrError, match="give an axis and where to cut"):
            read_section(text, clouds)


def test_colours(files):
    clouds, _ = load(files, None, None, 10_000)
    red, by_file = colors(clouds, "rgb")
    assert (red == [1, 0, 0]).all()
    np.testing.assert_allclose(by_file, np.tile(HUES[1], (500, 1)))
    assert missing(clouds, "rgb") == [f"{files[1]}: no rgb, coloured by file"]
    heights = colors(clouds, "height")[0]
    np.testing.assert_allclose(heights[BOX[:, 2].argmax()], RAMP[-1])
    np.testing.assert_allclose(heights[BOX[:, 2].argmin()], RAMP[0])
    measured = with_residuals(clouds)
    gap = measured[0].attributes["residual"]
    assert gap.min() == pytest.approx(np.linalg.norm(BOX[:, None] - BOX[None] - [10, 0, 0], axis=2).min())


def test_a_page(files, tmp_path):
    pytest.importorskip("jinja2")
    from fmr_cli.report.view_page import write_view

    clouds = with_residuals(load(files, None, None, 10_000)[0])
    write_view(tmp_path / "v.html", clouds, "height", 2.0, Section(2, 1.5, 0.2))
    data = data_of((tmp_path / "v.html").read_text("utf-8"))
    assert [c["rgb"] is not None for c in data["clouds"]] == [True, False]
    assert set(data["scales"]) == {"height", "intensity", "residual"}
    assert data["section"]["at"] == pytest.approx(1.5 - (BOX[:, 2].min() + BOX[:, 2].max()) / 2)
    drawn = numbers(data["clouds"][0]["points"], "<f4").reshape(-1, 3)
    assert np.ptp(drawn, axis=0) == pytest.approx(np.ptp(BOX, axis=0), abs=1e-5)


def test_a_picture_without_a_screen(files, tmp_path, monkeypatch):
    from fmr_cli.evaluation.open3d_import import Open3DError, open3d

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    try:
        open3d()
    except Open3DError as error:
        pytest.skip(str(error))
    clouds = load(files, None, None, 10_000)[0]
    window = view_window.Window(clouds, "file", 4.0, None)
    try:
        window.save(tmp_path / "v.png")
    except FmrError as error:
        assert "this machine cannot draw" in str(error)  # noqa: PT017
        pytest.skip(str(error))
    from matplotlib.image import imread

    pixels = imread(tmp_path / "v.png")[..., :3]
    for hue in HUES[:2]:
        assert (np.abs(pixels - hue).max(2) < 0.02).sum() > 50
    window.cut_along(2)
    few = len(window.shown[0].points)
    assert 0 < few < 100
    window.cut_along(2)
    assert len(window.shown[0].points) == 500


def test_no_screen_is_said_at_once(monkeypatch):
    monkeypatch.setattr(view_window.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(FmrError, match="no screen here"):
        view_window.check_screen()
