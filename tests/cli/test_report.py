"""`--report`, `--picture`, `--view` and `fmr view` as commands: what they write, what they refuse, what they import."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest


def test_a_report_and_a_picture_of_the_samples(tmp_path, fmr):
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    outputs = ["-o", tmp_path / "T.txt", "--report", tmp_path / "r.html", "--picture", tmp_path / "p.png"]
    done = fmr("align", "scan_a.ply", "scan_b.ply", *outputs)
    assert done.returncode == 0
    text = (tmp_path / "r.html").read_text("utf-8")
    assert text.startswith("<!doctype html>")
    assert f"Written: {tmp_path / 'T.txt'}" in text
    assert (tmp_path / "p.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("align", "scan_a.ply", "scan_b.ply", "--report", "r.pdf"), "cannot write the suffix '.pdf'"),
        (("align", "scan_a.ply", "scan_b.ply", "--report", "no/r.html"), "the output folder no does not exist"),
        (("align", "scan_a.ply", "scan_b.ply", "--picture", "p.gif"), "use one of .png .pdf .svg"),
        (("batch", "no.csv", "--out", "out", "--report", "r.txt"), "cannot write the suffix '.txt'"),
        (("multiway", ".", "--out", "out", "--report", "r.txt"), "cannot write the suffix '.txt'"),
        (("sequence", ".", "--out", "p.txt", "--report", "r.txt"), "cannot write the suffix '.txt'"),
        (("view",), "give files to view"),
        (("view", "scan_a.ply", "--section", "q"), "give an axis"),
        (("view", "no.ply"), "no.ply: no such file"),
        (("view", "scan_a.ply", "--screenshot", "s.gif"), "use one of .png .jpg"),
        (("view", "--result", "."), "holds neither network.json"),
    ],
)
def test_what_cannot_be_is_said_on_one_line(fmr, arguments, said):
    done = fmr(*arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(("option", "lacking"), [("--report", "jinja2"), ("--picture", "matplotlib")])
def test_without_the_extra_the_remedy_is_said_before_anything_is_read(fmr, tmp_path, monkeypatch, option, lacking):
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == lacking else there(name, *a))
    path = tmp_path / ("r.html" if option == "--report" else "p.png")
    done = fmr("align", "no_such.ply", "scan_b.ply", option, path)
    assert done.returncode == 2
    assert "pip install 'fmr-cli[report]'" in done.stderr


def test_align_imports_nothing_of_it_unasked_nor_open3d_nor_torch(samples):
    code = (
        "import sys, runpy\n"
        f"sys.argv = ['fmr', 'align', *{[str(samples / f'scan_{x}.ply') for x in 'ab']!r}, '-q']\n"
        "try:\n    runpy.run_module('fmr_cli.cli', run_name='__main__')\nexcept SystemExit:\n    pass\n"
        "heavy = ('jinja2', 'plotly', 'PIL', 'matplotlib', 'open3d', 'torch', 'fmr_cli.report')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr
