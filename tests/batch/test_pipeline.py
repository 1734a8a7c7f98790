"""`align_batch`: the same rows as in its file, told as they come, whatever ends the run."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import pytest

from fmr_cli import Options, align, read_cloud
from fmr_cli.batch import align_batch, cache, one_pair, pipeline
from fmr_cli.batch.manifest import Pair
from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import host
from fmr_cli.registration import export

SAMPLES = Path(__file__).parents[2] / "samples"


class CutError(Exception):
    """Stands for whatever ends a process."""


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    """Four pairs, of which the second has no target."""
    a, b = SAMPLES / "scan_a.ply", SAMPLES / "scan_b.ply"
    path = tmp_path_factory.mktemp("batch") / "pairs.csv"
    path.write_text(f"source,target\n{a},{b}\n{a},nowhere.ply\n{b},{a}\n{b},{b}\n")
    return path


@pytest.fixture(scope="module")
def whole(manifest, tmp_path_factory):
    """A whole run: its folder, its rows, and what it told."""
    out, told = tmp_path_factory.mktemp("whole"), []
    rows = align_batch(manifest, out, workers=1, on_row=lambda row, done, total: told.append((row, done, total)))
    return out, rows, told


def table(out):
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_it_returns_the_rows_of_its_file_and_tells_each(whole):
    out, rows, told = whole
    assert rows == table(out)
    assert told == [(row, number, 4) for number, row in enumerate(rows, 1)]
    assert [row["status"] == "failed" for row in rows] == [False, True, False, False]
    assert not (out / "aligned").exists()


def test_cut_off_and_gone_on_with_it_keeps_the_rows_it_has(manifest, tmp_path):
    def cut(row, done, total):
        if done == 2:
            raise CutError

    with pytest.raises(CutError):
        align_batch(manifest, tmp_path / "out", workers=1, on_row=cut)
    before = table(tmp_path / "out")
    assert len(before) == 2
    with pytest.raises(CloudFileError, match="is there already"):
        align_batch(manifest, tmp_path / "out")
    with subprocess.Popen(["true"]) as killed:
        killed.wait()
    half = tmp_path / "out" / "transforms" / f".scan_b_scan_a.{host()}-{killed.pid}-01234567.tmp.txt"
    half.write_text("1 0")
    told = []

    def on_row(row, done, total):
        told.append(done)

    rows = align_batch(manifest, tmp_path / "out", workers=1, resume=True, on_row=on_row)
    assert not half.exists()
    assert told == [3, 4]
    assert rows[:2] == before
    assert rows == table(tmp_path / "out")
    with pytest.raises(CloudFileError, match="other settings"):
        align_batch(manifest, tmp_path / "out", Options(seed=1), resume=True)


def test_a_file_of_several_pairs_is_read_once(tmp_path, monkeypatch):
    read = []
    monkeypatch.setattr(cache, "read_cloud", lambda path, **given: read.append(path.name) or read_cloud(path, **given))
    monkeypatch.setattr(one_pair, "align", lambda *_: (_ for _ in ()).throw(ValueError("not of interest")))
    a, b = SAMPLES / "scan_a.ply", SAMPLES / "scan_b.ply"
    (tmp_path / "pairs.csv").write_text("source,target\n" + 8 * f"{a},{b}\n{b},{a}\n")
    assert len(align_batch(tmp_path / "pairs.csv", tmp_path / "out", workers=1)) == 16
    assert sorted(read) == ["scan_a.ply", "scan_b.ply"]


def test_pairs_that_share_files_go_to_one_worker_and_spent_files_are_let_go_of(tmp_path):
    runner = one_pair.PairRunner(tmp_path, tmp_path, Options(), False, False, 0)
    pairs = [Pair(*ends, "", "") for ends in ("ab", "bc", "cd", "xy", "ya", "ac")]
    blocks = [*pipeline.in_blocks(runner, pairs, most=2)]
    assert ["".join(p.source + p.target for p in block.pairs) for block in blocks] == ["abbc", "cd", "xyya", "ac"]
    assert ["".join(sorted(path.name for path in block.spent)) for block in blocks] == ["b", "d", "xy", "ac"]
    assert [len(block.pairs) for block in pipeline.in_blocks(runner, pairs, most=4, sharing=False)] == [4, 2]


def test_the_metrics_of_each_pair_are_those_of_align(whole):
    out, _, _ = whole
    found = sorted(path.stem for path in (out / "metrics").iterdir())
    assert found == sorted(path.stem for path in (out / "transforms").iterdir())
    assert len(found) == 3
    metrics = json.loads((out / "metrics" / f"{found[0]}.json").read_text())
    a, b = (read_cloud(SAMPLES / f"scan_{name}.ply") for name in "ab")
    expected = export.metrics(a, b, align(a, b))
    assert {**metrics, "seconds": 0} == {**json.loads(json.dumps(expected)), "seconds": 0}
