"""`fmr evaluate`: tables to stdout, results.csv and plots into a folder, bad input on one line."""

from __future__ import annotations

import csv

import pytest

QUICK = ("--pairs", "4", "--points", "128", "--clouds", "1")


def test_tables_csv_and_plots(tmp_path, fmr_here, samples):
    done = fmr_here("evaluate", samples, *QUICK, "--experiments", "noise, scenes,features", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "noise: success" in done.stdout
    assert "scenes: success" in done.stdout
    with (tmp_path / "out/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {"bundled", "bundled, plain"}
    assert [row["level"] for row in rows if row["method"] == "bundled"] == [
        "0.0",
        "0.005",
        "0.01",
        "0.02",
        "0.04",
        "60.0",
    ]
    assert all(0 <= float(row["success"]) <= 1 for row in rows)


def test_plots_are_png_files(tmp_path, fmr_here, samples):
    pytest.importorskip("matplotlib")
    fmr_here("evaluate", samples, *QUICK, "--experiments", "density,features", "-o", "out", cwd=tmp_path)
    for name in ("density.png", "features_bundled.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")


def test_baselines_stand_beside_the_method(tmp_path, fmr_here, samples):
    done = fmr_here("evaluate", samples, *QUICK, "--experiments", "scenes", "--no-plain", "--baselines", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "evaluation/results.csv").open() as file:
        assert {"bundled", "LM-ICP", "small_gicp"} <= {row["method"] for row in csv.DictReader(file)}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--experiments", "colour"), "no such experiment; choose from rotation"),
        (("--model", "none.safetensors"), "none.safetensors: no such model file"),
        (("empty",), "empty: no scan in there"),
    ],
)
def test_bad_input_is_one_line(tmp_path, fmr_here, samples, arguments, said):
    (tmp_path / "empty").mkdir()
    done = fmr_here("evaluate", samples, *QUICK, *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
