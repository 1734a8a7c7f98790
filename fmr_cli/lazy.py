"""Names of a package that are loaded on first use, so that importing it starts at once."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def lazy(package: str, home: dict[str, str]) -> Callable[[str], Any]:
    """A package's ``__getattr__``; home: each public name and the module, absolute, that it comes from."""

    def load(name: str) -> Any:
        if name in home:
            return getattr(importlib.import_module(home[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load
