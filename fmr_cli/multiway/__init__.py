"""Many scans in any order: which pairs to try, their links, the network of poses, the joint refinement.

``pipeline.align_many`` is the whole way. The names below are loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {"align_many": "pipeline", "Network": "network", "Known": "known"}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"fmr_cli.multiway.{_HOME[name]}"), name)
    raise AttributeError(f"module 'fmr_cli.multiway' has no attribute {name!r}")
