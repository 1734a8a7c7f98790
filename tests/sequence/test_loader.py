"""Scans read ahead: by a thread or by a process, the same to the last bit."""

from __future__ import annotations

import multiprocessing
import os
import signal

import numpy as np
import pytest

from fmr_cli.sequence import find_scans, loader
from fmr_cli.sequence.loader import Loader
from fmr_cli.sequence.options import SequenceOptions
from fmr_cli.sequence.pipeline import begin


@pytest.fixture
def loaders(street, monkeypatch):
    """Makes a loader of eight scans, in a process or not; the process has started before the first is handed out."""
    scans = find_scans(street[0], stop=8)
    beginning = begin(scans, SequenceOptions(), None)
    hand_out = loader.Readers.hand_out

    def after_start(readers, *task):
        if readers.started:
            readers.started.result()
        return hand_out(readers, *task)

    monkeypatch.setattr(loader.Readers, "hand_out", after_start)

    def make(*, apart):
        monkeypatch.setattr(loader, "WORTH_A_PROCESS", 2 if apart else 100)
        monkeypatch.setattr(loader, "usable_cores", lambda: 2)
        return Loader(scans, beginning, [], strict=False, keep_clouds=False)

    return make


def arrays(loaded):
    return [loaded.scan.points, loaded.scan.normals, loaded.scan.solid, loaded.scan.ranges, loaded.scan.whole]


def test_a_process_makes_of_scans_what_a_thread_does(loaders, monkeypatch):
    here = list(loaders(apart=False).ahead(0))
    monkeypatch.setattr(loader, "prepare_scan", None)  # not to be done here
    there = list(loaders(apart=True).ahead(0))
    assert [a.index for a in there] == list(range(8))
    for a, b in zip(here, there, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(arrays(a), arrays(b), strict=True))
        assert a.size == b.size
        assert a.row["points"] == b.row["points"] > 0


def test_it_is_a_process_where_scans_are_many_and_lie_in_files(loaders, street, monkeypatch):
    one = loaders(apart=True)
    assert one._worth_a_process(2)
    assert not one._worth_a_process(1)
    monkeypatch.setattr(loader, "usable_cores", lambda: 1)
    assert not one._worth_a_process(2)
    monkeypatch.setattr(loader, "usable_cores", lambda: 2)
    one.keep_clouds = True
    assert not one._worth_a_process(2)


def test_a_process_that_is_killed_costs_no_scan(loaders):
    seen = []
    for loaded in loaders(apart=True).ahead(0):
        seen.append(loaded.index)
        if loaded.index == 1:
            (child,) = multiprocessing.active_children()
            os.kill(child.pid, signal.SIGKILL)
        assert loaded.scan is not None
    assert seen == list(range(8))
