"""This process and processes beside it: answers in order, whatever ends one of them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from workers import work

from fmr_cli.errors import FmrError
from fmr_cli.workers import Here, Processes
from fmr_cli.workers.base import AHEAD, LostError, kept
from fmr_cli.workers.local import on_this_machine


@pytest.mark.parametrize("workers", [Here(), Processes(2)])
def test_answers_come_in_the_tasks_order(workers):
    assert [*workers.run(work.later, range(6))] == [*range(6)]


def test_no_more_processes_than_tasks_and_none_for_one():
    assert isinstance(on_this_machine(4, 1), Here)
    assert on_this_machine(4, 3).count == 3
    given = Here()
    assert on_this_machine(given, 100) is given


def test_tasks_are_taken_when_they_are_handed_out():
    taken = []
    answers = Processes(2).run(work.process_of, (taken.append(number) or number for number in range(100)))
    processes = {next(answers) for _ in range(10)}
    assert os.getpid() not in processes
    assert len(taken) <= 10 + 2 * AHEAD
    answers.close()


def test_a_task_that_kills_its_process_takes_no_other_with_it():
    answers = [*Processes(2).run(work.dies_of_three, range(8))]
    assert [a for a in answers if not isinstance(a, LostError)] == [0, 1, 2, 4, 5, 6, 7]
    assert "died" in str(answers[3])


@pytest.mark.parametrize("workers", [Here(), Processes(2)])
def test_what_a_task_raises_is_raised(workers):
    answers = workers.run(work.complains_of_three, range(8))
    assert [next(answers) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(FmrError, match="three is too much"):
        next(answers)


def test_what_is_kept_is_kept_for_one_run():
    for _ in range(2):
        assert [*Here().run(work.so_far, range(3))] == [1, 2, 3]
    assert kept("done", list) == []
    assert [*Processes(1).run(work.so_far, range(3))] == [1, 2, 3]


SCRIPT = """
from workers import work
from fmr_cli.workers import Processes
print(sum(Processes(2).run(work.square, range(4))))
answers = Processes(2).run(work.process_of, range(100))
print(next(answers), flush=True)
import os, signal
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_script_needs_no_main_guard_and_leaves_no_process_behind(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    path = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    total, child = map(int, done.stdout.split())
    assert total == 14
    for _ in range(200):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{child}/stat").exists() and Path(f"/proc/{child}/stat").read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    raise AssertionError("a worker outlives the process that it works for")
