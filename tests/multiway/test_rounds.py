"""Which pairs are tried next, by what links there are."""

from __future__ import annotations

from fmr_cli.multiway.rounds import beside_lone_links, links_between


def graph(*links: tuple[int, int]) -> dict[int, set[int]]:
    near: dict[int, set[int]] = {n: set() for link in links for n in link}
    for a, b in links:
        near[a].add(b)
        near[b].add(a)
    return near


TRIANGLES = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5)]


def test_what_lies_beside_a_link_that_no_third_scan_confirms_is_to_be_tried():
    beside = beside_lone_links(graph(*TRIANGLES, (2, 3)))
    across = {(b, a) for a in (0, 1, 2) for b in (3, 4, 5)}
    assert across <= beside, "every scan next to one end, with every one next to the other"
    assert not beside_lone_links(graph(*TRIANGLES)), "in a triangle each link is confirmed by the third scan"
    assert not beside_lone_links(graph(*TRIANGLES, (2, 3), (2, 4), (1, 3))), (
        "nor where the link is one of two triangles"
    )


def test_links_between_scans_are_counted_up_to_a_round_trip():
    chain = links_between(graph(*((n, n + 1) for n in range(5))))
    assert [chain.get((0, n)) for n in range(1, 6)] == [1, 2, 3, None, None]
