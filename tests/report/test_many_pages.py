"""The reports of many scans and of learning: rows, networks, paths, curves; tables that sort and filter."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pages import MOST, Tags, data_of, numbers
from rooms import room_views

from fmr_cli import PointCloud, write_cloud, write_transform
from fmr_cli.geometry.frames import Frame, enter_frames
from fmr_cli.multiway.links import Hypothesis, Link
from fmr_cli.multiway.network import Network, Placed
from fmr_cli.multiway.scans import Scan
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.result import SequenceResult
from fmr_cli.sequence.scans import Scans

pytest.importorskip("jinja2")
pytest.importorskip("plotly")
pytest.importorskip("PIL")

EVIL = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Four scans of a room in files and in memory, and T_world_scan."""
    clouds, truth = room_views(5, 4, 2_000)
    folder = tmp_path_factory.mktemp("room")
    for n, points in enumerate(clouds):
        write_cloud(folder / f"scan{n}.ply", PointCloud(points))
    return folder, clouds, truth


@pytest.fixture(scope="module")
def network(room):
    """Three placed scans, one that is not; links of every status."""
    _, clouds, truth = room
    frames = {n: Frame(points.mean(0)) for n, points in enumerate(clouds)}
    common = np.linalg.inv(truth[0])
    scans = [Placed(f"scan{n}", f"scan{n}.ply", "placed", 0, common @ truth[n], None, 2, 0.002, 1e-6 * np.eye(6))
             for n in range(3)]  # fmt: skip
    scans.append(Placed(EVIL, "x.ply", "unplaced", message="no sure link"))

    def link(a: int, b: int, status: str, confidence: float, chosen: int | None) -> Link:
        T = enter_frames(np.linalg.inv(truth[b]) @ truth[a], frames[a], frames[b])
        return Link(a, b, status, "auto", [Hypothesis(T, confidence)], np.eye(6), 0.6, 0.01, 0.1, "", chosen)  # type: ignore[arg-type]

    links = [link(1, 0, "aligned", 0.99, 0), link(2, 1, "aligned", 0.95, 0), link(2, 0, "rejected", 0.8, None),
             link(3, 0, "uncertain", 0.2, None), Link(3, 1, "failed", "auto", message=EVIL)]  # fmt: skip
    sources = [Scan(s.name, PointCloud(c)) for s, c in zip(scans, clouds, strict=True)]
    return Network(scans, links, ["scan0"], [], frames, {}, {"read": 1.0, "total": 1.0}, {"fmr": "1"}, sources)


def test_a_network(network, tmp_path):
    from fmr_cli.report.multiway_page import write_multiway

    write_multiway(tmp_path / "n.html", network, ["a word"])
    text = (tmp_path / "n.html").read_text("utf-8")
    assert len(text) < MOST
    tags = Tags(text).tags
    assert [t for t, _ in tags].count("script") == 5
    assert sum(t == "img" for t, _ in tags) == 4 + 2  # of links with a pose, and again what to do
    assert all(a["src"].startswith("data:image/png;base64,") for t, a in tags if t == "img")
    data = data_of(text)
    assert [n["xy"] is not None for n in data["nodes"]] == [True, True, True, False]
    assert [(k["source"], k["target"], k["status"]) for k in data["links"]] == [
        (1, 0, "aligned"), (2, 1, "aligned"), (2, 0, "rejected"), (3, 0, "uncertain"), (3, 1, "failed"),
    ]  # fmt: skip
    assert "nothing is to be done" in text
    # All scans together: every point of one is near the others', as it is in the room.
    clouds = [numbers(c["points"], "<f4").reshape(-1, 3) for c in data["clouds"]]
    nearest = np.linalg.norm(clouds[1][:200, None] - clouds[0][None], axis=2).min(1)
    assert np.median(nearest) < 0.2


def test_a_network_of_which_nothing_is_placed(network, tmp_path):
    from fmr_cli.report.multiway_page import write_multiway

    lost = [replace(s, status="unplaced", component=None, T_component_scan=None) for s in network.scans]
    write_multiway(tmp_path / "n.html", replace(network, scans=lost, anchors=[]), [])
    assert data_of((tmp_path / "n.html").read_text("utf-8"))["nodes"] == []


def batch_rows(room, out: Path) -> list[dict[str, str]]:
    _, _, truth = room
    (out / "transforms").mkdir(parents=True)
    rows = []
    pairs = [(1, 0, "aligned", "0.99"), (2, 1, "aligned", "0.9"), (3, 2, "uncertain", "0.3")]
    for n, (a, b, status, confidence) in enumerate(pairs):
        write_transform(out / "transforms" / f"{n}.txt", np.linalg.inv(truth[b]) @ truth[a])
        rows.append({"source": f"scan{a}.ply", "target": f"scan{b}.ply", "status": status, "confidence": confidence,
                     "overlap": "0.5", "inlier_rmse": "0.01", "seconds": "1.5", "transform": f"transforms/{n}.txt",
                     "message": "only 9% of the smaller scan lies on the other one" if n == 2 else ""})  # fmt: skip
    empty = {"confidence": "", "overlap": "", "inlier_rmse": "", "transform": "", "seconds": "0.1"}
    bad = {"source": f"{EVIL}.ply", "target": "scan0.ply", "status": "failed", "message": f"{EVIL}: no such file"}
    return [*rows, bad | empty]


@pytest.fixture
def batch_page(room, tmp_path):
    from fmr_cli.report.batch_page import write_batch

    write_batch(tmp_path / "b.html", room[0], tmp_path / "out", batch_rows(room, tmp_path / "out"))
    return tmp_path / "b.html"


def test_a_batch(room, batch_page):
    text = batch_page.read_text("utf-8")
    assert [t for t, _ in Tags(text).tags].count("script") == 5
    data = data_of(text)
    names = {n["name"]: n["xy"] for n in data["nodes"]}
    assert names["scan3.ply"] is None  # joined by an uncertain pair alone
    _, clouds, truth = room
    middles = [np.linalg.inv(truth[0]) @ truth[n] @ [*clouds[n].mean(0), 1] for n in range(3)]
    axes = ["xyz".index(a) for a in data["axes"]]
    for n in (1, 2):  # placed along the chain of pairs as the truth has it
        apart = np.subtract(names[f"scan{n}.ply"], names["scan0.ply"])
        np.testing.assert_allclose(apart, (middles[n] - middles[0])[axes], atol=0.02)
    assert "Check the two files" in text


def test_a_batch_whose_pairs_share_nothing_has_no_network(room, tmp_path):
    from fmr_cli.report.batch_page import write_batch

    write_batch(tmp_path / "b.html", room[0], tmp_path / "out", batch_rows(room, tmp_path / "out")[:1])
    assert data_of((tmp_path / "b.html").read_text("utf-8"))["nodes"] == []


def test_in_a_browser_a_table_is_sorted_and_filtered(batch_page, opened):
    browser = opened(batch_page)
    shown = (
        "return [...document.querySelectorAll('#links-table tbody tr')].filter(r => !r.hidden)"
        ".map(r => r.cells[4].textContent.trim())"
    )
    assert browser.execute_script(shown) == ["0.99", "0.9", "0.3", "\u2013"]
    head = browser.find_element("css selector", "#links-table thead th:nth-child(5) button")
    head.click()
    assert browser.execute_script(shown) == ["0.3", "0.9", "0.99", "\u2013"]
    head.click()
    assert browser.execute_script(shown) == ["0.99", "0.9", "0.3", "\u2013"]
    browser.find_element("css selector", "input[type=checkbox][value=aligned]").click()
    assert browser.execute_script(shown) == ["0.3", "\u2013"]
    browser.find_element("css selector", "input[type=search]").send_keys("scan3")
    assert browser.execute_script(shown) == ["0.3"]


@pytest.fixture
def sequence(room):
    """Five frames that go straight on, the last but one uncertain, with a loop."""
    _, clouds, _ = room
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    rows = [{"frame": n, "file": f"{n}.ply", "status": "aligned", "start": "prediction", "overlap": 0.9, "motion": 1.0,
             "inlier_rmse": 0.01 * n, "rotation_deg": 0.0, "register_s": 0.1} for n in range(5)]  # fmt: skip
    rows[3] |= {"status": "uncertain", "file": f"{EVIL}.ply", "unobserved": "shift along (1.00, 0.00, 0.00)",
                "sigma_shift": 2.0, "sigma_rotation_deg": 0.1}  # fmt: skip
    scans = Scans([PointCloud(clouds[0])] * 5, range(5), 5)
    return SequenceResult(poses, rows, 0.2, poses + 0.01, 1, None, ((0, 4),)), scans


def test_a_sequence(sequence, tmp_path):
    from fmr_cli.report.sequence_page import write_sequence

    write_sequence(tmp_path / "s.html", *sequence, SequenceOptions(loop_closure=True))
    text = (tmp_path / "s.html").read_text("utf-8")
    tags = Tags(text).tags
    assert [t for t, _ in tags].count("script") == 4
    assert sum(t == "img" for t, _ in tags) == 1  # the frame to look at
    data = data_of(text)
    assert data["loops"] == [[0, 4]]
    for view in data["views"]:
        wanted = [[float(n) if axis == "x" else 0.0 for axis in view["axes"]] for n in range(5)]
        assert view["xy"] == wanted
    assert [row["sigma_shift"] for row in data["rows"]] == [None, None, None, 2.0, None]
    assert "1 loops closed" in text


def test_a_sequence_by_a_camera_is_drawn_where_the_scanner_was(sequence, tmp_path):
    from fmr_cli.report.sequence_page import in_scanner_frame

    result, scans = sequence
    T_camera_scan = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    camera = replace(result, poses=T_camera_scan @ result.poses @ np.linalg.inv(T_camera_scan))
    found = in_scanner_frame(camera, replace(scans, T_camera_scan=T_camera_scan), SequenceOptions(camera_frame=True))
    np.testing.assert_allclose(found, result.poses, atol=1e-12)


def test_an_evaluation(tmp_path):
    from fmr_cli.evaluation.experiments import Row
    from fmr_cli.report.evaluation_page import write_evaluation

    rows = [Row("rotation", EVIL, method, level, 10, share, 1, 1, 0.1, 0.1, 0.1, 0.1, 0.01)
            for method in ("a", "b") for level, share in ((0, 1.0), (60, 0.5))]  # fmt: skip
    write_evaluation(tmp_path / "e.html", rows, {"pairs": 10})
    data = data_of((tmp_path / "e.html").read_text("utf-8"))
    (group,) = data["groups"]
    line = group["plots"][0]["series"][1]
    assert (line["name"], line["at"], line["values"]) == ("b", [0, 60], [1.0, 0.5])
    assert line["low"][1] == pytest.approx(0.2366, abs=1e-4)  # Wilson, 5 of 10
    assert line["high"][0] == 1.0


def test_an_evaluation_of_cross_source_pairs_shows_the_verdict_and_no_empty_columns(tmp_path):
    from fmr_cli.evaluation.experiments import Row
    from fmr_cli.report.evaluation_page import write_evaluation

    rows = [Row("cross-source", "onto a laser", "a", level, 10, share, 1, 1, 0.1, 0.1, 0.1, 0.1, 0.01,
                scale_median=0.02, aligned_right=share, aligned_wrong=0.1)
            for level, share in ((0.5, 0.9), (1.0, 0.5))]  # fmt: skip
    write_evaluation(tmp_path / "e.html", rows, {"pairs": 10})
    text = (tmp_path / "e.html").read_text("utf-8")
    assert "Aligned, wrong" in text
    assert "Times the limit" not in text
    plots = data_of(text)["groups"][0]["plots"]
    assert [p["series"][0]["values"] for p in plots] == [[0.9, 0.5], [0.02, 0.02], [0.9, 0.5], [0.1, 0.1]]
    assert plots[3]["series"][0]["high"][0] > 0.1


def test_a_data_set(tmp_path):
    from fmr_cli.evaluation.benchmark import Outcome, Summary
    from fmr_cli.evaluation.quoted import Quoted
    from fmr_cli.report.evaluation_page import write_dataset

    shifts = [0.0, 0.1, 0.2, np.nan]
    rows = [Outcome("s", EVIL, f"{n}", "fmr align", n < 2, float(n), shifts[n], np.nan, "aligned", 0.9, 1.0)
            for n in range(4)]  # fmt: skip
    data = SimpleNamespace(name="ETH", pairs=rows, right=SimpleNamespace(text="below 5 deg"), notes=[])
    measured = [Summary("fmr align", 4, 0.5, 0.5, 1.0, 0.1, 0.5, 1.0, 1.0, 1.0, 0)]
    quoted = [Quoted("ETH", "SpinNet", 73.07, 1.2, None, "somewhere")]
    write_dataset(tmp_path / "d.html", data, measured, quoted, rows, {})  # type: ignore[arg-type]
    text = (tmp_path / "d.html").read_text("utf-8")
    rotation, shift = data_of(text)["groups"][0]["plots"]
    assert rotation["series"][0]["values"] == [0.25, 0.5, 0.75, 1.0]
    assert shift["series"][0]["values"] == [0.25, 0.5, 0.75]  # the one without a pose stays outside
    assert re.findall(r'<tr data-status="(\w+)"', text) == ["wrong", "wrong", "right", "right"]
    assert "quoted: somewhere" in text


def test_the_plot_of_a_training_run(tmp_path):
    from fmr_cli.report.training import plot

    (tmp_path / "metrics.csv").write_text(
        "epoch,step,loss_point,noise: success\n0,0,,0.5\n1,100,0.2,0.75\n2,200,0.1,0.8\n"
    )
    shares = {"before": {"right": 5, "aligned": 4}, "after": {"right": 8, "aligned": 4}}
    rows = [{"kind": "room", "overlap": "10 to 30", "pairs": 10, **shares}]
    for check in (None, {"rows": rows}):
        trainer = SimpleNamespace(
            folder=SimpleNamespace(path=tmp_path),
            task=SimpleNamespace(measure="success"),
            progress=SimpleNamespace(check=check),
        )
        assert plot(trainer) == ""  # type: ignore[arg-type]
        assert (tmp_path / "training.png").read_bytes().startswith(b"\x89PNG")


def test_a_training_run(tmp_path, monkeypatch):
    from fmr_cli.report import training_page

    (tmp_path / "metrics.csv").write_text(
        "epoch,step,seconds,loss_point,success,noise: median deg,density: median deg\n"
        "0,0,0.1,,0.5,2.5,3\n1,100,9,0.2,0.75,1.5,2\n"
    )
    (tmp_path / "recipe.toml").write_text("# <b>\n")
    trainer = SimpleNamespace(
        folder=SimpleNamespace(path=tmp_path), quality=lambda epoch: (0.5 if epoch == 0 else 0.75,),
        progress=SimpleNamespace(best=1, step=100, seconds=9.0, epoch=2, scores={}, check=None),
        task=SimpleNamespace(measure="success", measured="x", described=["y"]),
    )  # fmt: skip
    monkeypatch.setattr(training_page, "score_table", lambda _: [("noise", "0.5", "0.75")])
    monkeypatch.setattr(training_page, "verdict", lambda *_: "better")
    training_page.write_training(tmp_path / "t.html", trainer, False)
    text = (tmp_path / "t.html").read_text("utf-8")
    losses, held = data_of(text)["groups"]
    assert losses["plots"][0]["series"] == [{"name": "point", "at": [100], "values": [0.2], "low": None, "high": None}]
    assert [p["y"] for p in held["plots"]] == ["success", "median deg"]
    assert [s["values"] for s in held["plots"][1]["series"]] == [[2.5, 1.5], [3, 2]]
    assert re.search(r"# &lt;b&gt;", text)
