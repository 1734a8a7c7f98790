"""For the Python reference: what a docstring says of a parameter or field begins a paragraph, its name in bold."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

import griffe

NAMED = re.compile(r"^(\w+(?:, \w+)*): ")  # "source, target: ..." at the start of a line


class Fields(griffe.Extension):
    """A griffe extension; the docstrings themselves stay as they read in the code."""

    def on_function_instance(self, *, func: griffe.Function, **_: Any) -> None:
        show(func, [parameter.name for parameter in func.parameters])

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        show(cls, list(cls.members))


def show(described: griffe.Object, names: Collection[str]) -> None:
    if described.docstring is None:
        return
    lines = []
    for line in described.docstring.value.splitlines():
        found = NAMED.match(line)
        if found and set(found[1].split(", ")) <= set(names):
            line = f"\n**{found[1]}**: {line[found.end() :]}"
        lines.append(line)
    described.docstring.value = "\n".join(lines)
