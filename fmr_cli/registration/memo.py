"""A bounded memory of what was computed: for one cloud that meets many partners."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any


class Memo:
    """Keeps the ``size`` values that were used last, each under a key of everything that it depends on."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of the key, made where it is not there. Two threads may make the same value at once: they agree."""
        return self.renew(key, lambda known: make() if known is None else known)

    def renew(self, key: Hashable, make: Callable[[Any], Any]) -> Any:
        """The value that ``make`` makes of the one that is there, or of None."""
        value = make(self.kept.get(key))
        self.kept[key] = value
        self.kept.move_to_end(key)
        while len(self.kept) > self.size:
            self.kept.popitem(last=False)
        return value
