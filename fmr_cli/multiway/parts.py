"""Which scans hang together, by the pairs that are linked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set


def parts(scans: Iterable[int], pairs: Iterable[tuple[int, int]]) -> dict[int, int]:
    """The part that each scan is in, named by one of its scans: pairs that share a scan are in one part."""
    home = {n: n for n in scans}
    for i, j in pairs:
        a, b = home[i], home[j]
        if a != b:
            home = {n: a if h == b else h for n, h in home.items()}
    return home


def in_triangles(near: Mapping[int, Set[int]]) -> dict[int, set[int]]:
    """By scan, those that it is linked to with a third scan that is linked to both. near: by scan, all linked to it."""
    return {i: {j for j in near[i] if near[i] & near[j]} for i in near}
