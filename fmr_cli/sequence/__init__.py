"""Many scans, in order: odometry against a local map, loops, a trajectory and a map.

``pipeline.align_sequence`` is the whole way of a sequence. The names below are loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "align_sequence": "pipeline",
    "SequenceOptions": "options",
    "SequenceResult": "result",
    "Scans": "scans",
    "find_scans": "scans",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"fmr_cli.sequence.{_HOME[name]}"), name)
    raise AttributeError(f"module 'fmr_cli.sequence' has no attribute {name!r}")
