"""Many pairs from a manifest: each file read and prepared once, a row a pair, resumable.

``pipeline.align_batch`` is the whole way of a batch. The names below are loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "align_batch": "pipeline",
    "read_manifest": "manifest",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"fmr_cli.batch.{_HOME[name]}"), name)
    raise AttributeError(f"module 'fmr_cli.batch' has no attribute {name!r}")
