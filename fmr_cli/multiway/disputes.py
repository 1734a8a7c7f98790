"""What hangs on one link alone, while another one that is about as sure has it elsewhere, is taken off."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from fmr_cli.multiway.claims import agreeing, contradicted, log_odds
from fmr_cli.multiway.components import Component, Join, homes
from fmr_cli.multiway.links import Link

DISPUTED = 0.1  # probability that a link is the wrong one of a cycle, from which nothing hangs on it alone


def undisputed(
    component: Component, links: list[Link], moments: dict[int, np.ndarray], scans: set[int], forbidden_links: set[int]
) -> tuple[list[Component], list[Join]]:
    """The parts of a component that don't hang on a link which is as likely wrong as one that contradicts it.

    A sure link that the poses contradict closes a cycle with those that they agree with, of which one at least is
    wrong. Where others bypass it, they tell which. Of those that nothing bypasses (bridges), and of the link itself,
    P(k is wrong) is in proportion to exp(-log odds of k). Also gives the joins that are taken off.
    scans: whose views tell. forbidden_links: by number; they deny nothing, since views forbid what they say.
    """
    poses = component.T_component_scan
    holding: dict[int, float] = {}  # links, by number: their log odds
    against: dict[int, float] = {}
    for number, link in enumerate(links):
        if link.source not in poses or link.target not in poses:
            continue
        told = link.source in scans
        agreed = agreeing(link, poses, moments[link.source], told)
        if agreed:
            holding[number] = max(log_odds(link.hypotheses[k], told) for k in agreed)
        elif link.status == "aligned" and number not in forbidden_links and not contradicted(link.hypotheses[0], told):
            against[number] = log_odds(link.hypotheses[0], told)
    if component.held:  # whatever its scans' links say, they are where they are
        holding = {n: x for n, x in holding.items() if not component.held.issuperset(links[n].ends)}
    cut: dict[int, float] = {}  # links that are taken off: the probability that each is right
    for number in sorted(against, key=lambda n: (-against[n], n)):
        bridges = bridges_between(component, links, [n for n in holding if n not in cut], *links[number].ends)
        if bridges:
            odds = np.array([against[number], *(holding[n] for n in bridges)])
            wrong = np.exp(-odds - np.logaddexp.reduce(-odds))
            cut.update({n: 1 - float(p) for n, p in zip(bridges, wrong[1:], strict=True) if p > DISPUTED})
    if not cut:
        return [component], []
    ends = [links[n].ends for n in holding if n not in cut]
    loose = sorted(set(homes(component, [links[n].ends for n in holding]).values()))
    ends += [(loose[0], other) for other in loose[1:]]  # joined by what agrees too little to hold by itself
    groups: dict[int, dict[int, np.ndarray]] = defaultdict(dict)
    for n, home in homes(component, ends).items():
        groups[home][n] = poses[n]
    pieces = [Component(group, component.held & group.keys()) for group in groups.values()]
    joins = [Join(np.eye(4), holding[n], right, 1 - right, (n,), 0, True) for n, right in sorted(cut.items())]
    return pieces, joins


def bridges_between(component: Component, links: list[Link], some: list[int], source: int, target: int) -> list[int]:
    """Those of ``some`` links, by number, without any one of which two scans of a component fall apart."""
    ends = {n: links[n].ends for n in some}
    near: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for n, (i, j) in ends.items():
        near[i].append((j, n))
        near[j].append((i, n))
    came: dict[int, tuple[int, int]] = {source: (source, -1)}  # by a search in width: the scan before, and the link
    front = [source]
    while front and target not in came:
        reached = []
        for k in front:
            for m, n in near[k]:
                if m not in came:
                    came[m] = k, n
                    reached.append(m)
        front = reached
    path = []
    at = target if target in came else source
    while at != source:
        at, n = came[at]
        path.append(n)
    apart = (homes(component, [e for m, e in ends.items() if m != n]) for n in path)  # a bridge lies on every way
    return [n for n, home in zip(path, apart, strict=True) if home[source] != home[target]]
