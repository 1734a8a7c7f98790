"""Scans read ahead: by a thread or by a process, the same to the last bit."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace

import numpy as np
import pytest

from fmr_cli.sequence import find_scans, loader, readers
from fmr_cli.sequence.loader import Loader
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.pipeline import begin
from fmr_cli.sequence.scans import as_scans


@pytest.fixture
def read_ahead(street, monkeypatch):
    """Eight scans, read in a process or not; the process has started before the first is handed out."""
    scans = find_scans(street[0], stop=8)
    beginning = begin(scans, SequenceOptions(), None)
    hand_out = readers.Readers.hand_out

    def after_start(self, *task):
        if self.started:
            self.started.result()
        return hand_out(self, *task)

    monkeypatch.setattr(readers.Readers, "hand_out", after_start)

    def loaded(*, apart):
        with readers.Readers(apart) as hands:
            yield from Loader(scans, beginning, [], strict=False, keep_clouds=False).ahead(0, hands)

    return loaded


def arrays(loaded):
    return [loaded.scan.points, loaded.scan.normals, loaded.scan.solid, loaded.scan.ranges, loaded.scan.whole]


def test_a_process_makes_of_scans_what_a_thread_does(read_ahead, monkeypatch):
    here = list(read_ahead(apart=False))
    monkeypatch.setattr(loader, "prepare_scan", None)  # not to be done here
    there = list(read_ahead(apart=True))
    assert [a.index for a in there] == list(range(8))
    for a, b in zip(here, there, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(arrays(a), arrays(b), strict=True))
        assert a.size == b.size
        assert a.row["points"] == b.row["points"] > 0


def test_it_is_a_process_where_scans_are_many_and_lie_in_files(street, monkeypatch):
    monkeypatch.setattr(readers, "usable_cores", lambda: 2)
    scans, many = find_scans(street[0], stop=8), readers.WORTH_A_PROCESS
    assert readers.worth_a_process(scans, many, keep_clouds=False)
    assert not readers.worth_a_process(scans, many - 1, keep_clouds=False)
    assert not readers.worth_a_process(scans, many, keep_clouds=True)
    in_memory = as_scans([scans.read(index, attributes=False) for index in range(2)])
    assert not readers.worth_a_process(in_memory, many, keep_clouds=False)
    monkeypatch.setattr(readers, "usable_cores", lambda: 1)
    assert not readers.worth_a_process(scans, many, keep_clouds=False)


def test_scans_that_are_deskewed_need_no_process(street):
    scans = find_scans(street[0], stop=3)
    beginning = replace(begin(scans, SequenceOptions(), None), deskewed=True)
    with readers.Readers(apart=True) as hands:
        scan = next(Loader(scans, beginning, [np.eye(4)] * 3, strict=False, keep_clouds=False).ahead(0, hands))
        assert scan.scan is not None
        assert hands.process is None


def test_a_process_that_is_killed_costs_no_scan(read_ahead):
    seen = []
    for loaded in read_ahead(apart=True):
        seen.append(loaded.index)
        if loaded.index == 1:
            (child,) = multiprocessing.active_children()
            os.kill(child.pid, signal.SIGKILL)
        assert loaded.scan is not None
    assert seen == list(range(8))
