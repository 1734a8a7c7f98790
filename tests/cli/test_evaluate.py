"""`fmr evaluate`: tables to stdout, results.csv and plots into a folder, bad input on one line."""

from __future__ import annotations

import csv

import layouts
import pytest

QUICK = ("--pairs", "2", "--points", "128", "--clouds", "1", "--no-align")


def test_tables_csv_and_plots(tmp_path, fmr, samples):
    done = fmr("evaluate", samples, *QUICK, "--experiments", "noise, scenes, features", "-o", "out", cwd=tmp_path)
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
    pytest.importorskip("matplotlib")
    for name in ("noise.png", "features_bundled.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_baselines_stand_beside_the_method(tmp_path, fmr, samples):
    done = fmr("evaluate", samples, *QUICK, "--experiments", "scenes", "--no-plain", "--baselines", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "evaluation/results.csv").open() as file:
        assert {"bundled", "LM-ICP", "small_gicp"} <= {row["method"] for row in csv.DictReader(file)}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--experiments", "colour"), "no such experiment; choose from rotation"),
        (("--experiments", "refine,colour"), "--experiments colour: no such experiment"),
        (("--model", "none.safetensors"), "none.safetensors: no such model file"),
        (("empty",), "empty: no scan in there"),
    ],
)
def test_bad_input_is_one_line(tmp_path, fmr, samples, arguments, said):
    (tmp_path / "empty").mkdir()
    done = fmr("evaluate", samples, *QUICK, *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "no SCANS: give a data set or folders of scans, or --experiments refine or cross-source"),
        (("--experiments", "refine,noise,features"), "--experiments noise,features: give folders of scans"),
    ],
)
def test_what_needs_scans_says_so(tmp_path, fmr, arguments, said):
    done = fmr("evaluate", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_last_steps_are_compared_without_any_scans(tmp_path, fmr):
    few = ("--experiments", "refine-sensors", "--pairs", "1", "--points", "200")
    done = fmr("evaluate", *few, "-o", "out", "--report", "r.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "refine-sensors: median errors of 1 pairs each" in done.stdout
    with (tmp_path / "out/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * 7
    assert {row["clouds"] for row in rows} == {"made up"}
    assert all(float(row["limit_median"]) > 0 and float(row["limit_ratio"]) > 0 for row in rows)
    assert {row["scale_median"] for row in rows} == {""}  # not measured
    assert "the limit is the Cramér-Rao bound" in (tmp_path / "r.html").read_text("utf-8")


@pytest.mark.slow
def test_last_steps_are_compared_on_the_scans_given(tmp_path, fmr, samples):
    few = ("--experiments", "refine-noise", "--pairs", "1", "--points", "200", "--clouds", "1")
    done = fmr("evaluate", samples, *few, "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out/results.csv").open() as file:
        assert {row["clouds"] for row in csv.DictReader(file)} == {samples.name}


@pytest.fixture(scope="module")
def pairs_csv(tmp_path_factory, samples):
    """A CSV of the two sample scans, onto each other and the other way round, and a line whose scan is missing."""
    import numpy as np

    truth = np.loadtxt(samples / "truth.txt")
    rows = [("scan_a", "scan_b", truth), ("scan_b", "scan_a", np.linalg.inv(truth)), ("none", "scan_b", truth)]
    path = tmp_path_factory.mktemp("pairs") / "pairs.csv"
    path.write_text(
        "source,target,transform\n"
        + "".join(
            f"{samples / s}.ply,{samples / t}.ply,{' '.join(map(repr, T[:3].ravel().tolist()))}\n" for s, t, T in rows
        )
    )
    return path


def test_the_product_stands_beside_the_solver_alone(tmp_path, fmr, samples):
    one = ("--pairs", "1", "--points", "512", "--clouds", "1", "--experiments", "scenes", "--no-plain")
    done = fmr("evaluate", samples, *one, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "evaluation/results.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"fmr align", "bundled"}
    assert rows["fmr align"]["success"] == "1.0"


def test_a_data_set_is_told_by_its_files(tmp_path, fmr, pairs_csv):
    done = fmr("evaluate", pairs_csv, "--no-plain", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "pairs: 3 pairs; right: 5 deg, 2% of the source's diagonal" in done.stdout
    assert "2 of 6 rows failed and count as wrong; the first: fmr align" in done.stderr
    with (tmp_path / "out/results.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"fmr align", "solver alone"}
    ours = rows["fmr align"]
    assert (ours["recall"], ours["precision_of_aligned"], ours["failed"]) == ("66.67", "100", "1")
    assert float(ours["rre_deg"]) < 0.5
    with (tmp_path / "out/pairs.csv").open() as file:
        assert [row["right"] for row in csv.DictReader(file) if row["method"] == "fmr align"] == ["1", "1", "0"]


def test_what_is_quoted_is_marked(tmp_path, fmr):
    layouts.write_eth(tmp_path / "eth")
    pytest.importorskip("jinja2")
    few = ("--pairs", "1", "--no-plain", "--no-align")
    done = fmr("evaluate", "eth", *few, "-o", "out", "--report", "r.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "quoted: latex_tables/ETH_results.tex" in (tmp_path / "r.html").read_text("utf-8")
    with (tmp_path / "out/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows if row["measured"] == "yes"] == ["solver alone"]
    quoted = [row for row in rows if row["measured"] == "no"]
    assert quoted
    assert all("github.com" in row["source"] and not row["pairs"] for row in quoted)


def test_a_data_set_and_experiments_exclude_each_other(tmp_path, fmr, pairs_csv):
    done = fmr("evaluate", pairs_csv, "--dataset", "pairs", "--experiments", "noise", cwd=tmp_path)
    assert done.returncode == 2
    assert "give one of the two" in done.stderr
