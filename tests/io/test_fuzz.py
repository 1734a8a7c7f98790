"""Mutations of valid files of every dialect: each is read, or refused in one line; nothing crashes, hangs or prints."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
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


def test_the_fuzzer_goes_on_after_a_file_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first process is ended by the clock it sets while it reads its third file; the second begins behind that."""
    from benchmarks import fuzz

    asked = []

    def process(command: list[str], **_: object) -> subprocess.CompletedProcess:
        asked.append([int(command[command.index(f"--{name}") + 1]) for name in ("seed", "count")])
        (tmp_path / "last").write_text("2-a.csv")
        code, said = (-signal.SIGPROF, "") if len(asked) == 1 else (0, '{"executions": 7, "rows": {}}')
        return subprocess.CompletedProcess(command, code, said, "")

    monkeypatch.setattr(fuzz.subprocess, "run", process)
    total, findings = run(seed=0, count=10, minutes=None, folder=tmp_path)
    assert asked == [[0, 10], [3, 7]]
    assert (total, findings) == (10, [{"file": "2-a.csv", "wrong": "more than 30 s"}])


@pytest.mark.parametrize("number", FOUND)
def test_what_was_found_stays_mended(tmp_path: Path, capfd: pytest.CaptureFixture, number: int) -> None:
    corpus = examples()
    example = next(e for e in corpus if e.name == FOUND[number])
    path = tmp_path / example.name
    path.write_bytes(mutated(example, random.Random(number)))
    with pytest.raises(CloudFileError, match="damaged table"):
        read_cloud(path)
    assert capfd.readouterr().err == ""


def test_a_number_of_very_many_digits(tmp_path: Path) -> None:
    """Found by mutation 5553314: the pattern of Fortran's exponents went over a megabyte of digits once for each."""
    path = tmp_path / "a.txt"
    path.write_text("1 2 3\n4 5 " + "9" * 900_000 + "x\n")
    begin = time.process_time()
    with pytest.raises(CloudFileError, match="line 2: expected 3 numbers"):
        read_cloud(path)
    assert time.process_time() - begin < 60  # it was hours


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_a_word_of_any_length_makes_no_long_message(tmp_path: Path, name: str) -> None:
    """Found by mutations 5032449 and 5443555: what a message quotes of a header could be a megabyte."""
    word = "9" * 5000
    head = {
        "a.ply": f"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float {word}\nend_header\n1 2\n",
        "a.pcd": f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA {word}\n1 2 3\n",
    }[name]
    (tmp_path / name).write_text(head)
    with pytest.raises(CloudFileError) as error:
        read_cloud(tmp_path / name)
    assert len(str(error.value)) < len(str(tmp_path)) + 600


def test_an_array_that_python_2_has_written_is_read_in_silence(tmp_path: Path) -> None:
    """Found by mutation 5095861: numpy said on stderr that the header took longer to read."""
    np.save(tmp_path / "a.npy", np.arange(30.0).reshape(10, 3))
    data = (tmp_path / "a.npy").read_bytes().replace(b"(10, 3)", b"(10L,3)")
    (tmp_path / "a.npy").write_bytes(data)
    # A process of its own, without the warnings' filters of the tests
    code = f"from fmr_cli import read_cloud; print(len(read_cloud({str(tmp_path / 'a.npy')!r})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("10\n", "")


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
