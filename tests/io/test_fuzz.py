"""Mutations of valid files of every dialect: each is read, or refused in one line; nothing crashes, hangs or prints."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from benchmarks.corpus import examples
from benchmarks.fuzz import mutated, run
from fmr_cli.errors import CloudFileError
from fmr_cli.io import read_cloud

# What longer runs have found: the number of the mutation, and of what file it was made
FOUND = {
    5463: "las2_0.laz",  # a chunk of 2^63 bytes: lazrs panicked, and said so on stderr
}


@pytest.mark.parametrize(("seed", "count"), [(0, 200), pytest.param(200, 1300, marks=pytest.mark.slow)])
def test_malformed_files_are_read_or_refused(tmp_path: Path, seed: int, count: int) -> None:
    """A few of each format here; the long runs are ``python -m benchmarks.fuzz``."""
    total, findings = run(seed=seed, count=count, minutes=None, folder=tmp_path)
    assert findings == []
    assert total == count


def test_the_fuzzer_notices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that raises, prints, takes memory or time is a finding."""
    from benchmarks import fuzz

    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    assert fuzz.said_wrong(path) is None
    for error, what in ((ValueError("x"), "ValueError: x"), (CloudFileError("x"), "message 'x'")):
        monkeypatch.setattr(fuzz, "read_cloud", lambda *_, error=error, **__: (_ for _ in ()).throw(error))
        assert fuzz.said_wrong(path) == what
    monkeypatch.setattr(fuzz, "SECONDS", 0.01)
    monkeypatch.setattr(fuzz, "read_cloud", lambda *_, **__: sum(range(2_000_000)))
    assert str(fuzz.said_wrong(path)).endswith(" s")


@pytest.mark.parametrize("number", FOUND)
def test_what_was_found_stays_mended(tmp_path: Path, capfd: pytest.CaptureFixture, number: int) -> None:
    corpus = examples()
    example = next(e for e in corpus if e.name == FOUND[number])
    path = tmp_path / example.name
    path.write_bytes(mutated(example, random.Random(number)))
    with pytest.raises(CloudFileError, match="damaged table"):
        read_cloud(path)
    assert capfd.readouterr().err == ""


def test_a_name_that_is_repeated_very_often(tmp_path: Path) -> None:
    """Found by mutation 22957: a megabyte of one name took 2.6 s."""
    from fmr_cli.io.fields import unique

    names = unique(["a", "a_2", *["a"] * 50_000])
    assert names[:4] == ["a", "a_2", "a_3", "a_4"]
    assert len(set(names)) == 50_002
    path = tmp_path / "a.csv"
    path.write_text("x,y,z" + ",a" * 200_000 + "\n1,2,3\n")
    with pytest.raises(CloudFileError, match="has 200003 columns, it is no table of points"):
        read_cloud(path)
