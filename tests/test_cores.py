from __future__ import annotations

import os

from fmr_cli.cores import usable_cores


def test_cores_are_counted_on_every_system(monkeypatch):
    assert 1 <= usable_cores() <= os.cpu_count()
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # as on macOS and Windows
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert usable_cores() == 6
    monkeypatch.setattr(os, "cpu_count", lambda: None)  # not known
    assert usable_cores() == 1
