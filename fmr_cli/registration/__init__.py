"""One pair of clouds: options, the prepared cloud, hypotheses, refinement, confidence, the result.

``pipeline.align`` is the whole way of a pair. The names below are loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "align": "pipeline",
    "prepare": "pipeline",
    "Options": "options",
    "Prepared": "prepared",
    "Registration": "result",
}

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"fmr_cli.registration.{_HOME[name]}"), name)
    raise AttributeError(f"module 'fmr_cli.registration' has no attribute {name!r}")
