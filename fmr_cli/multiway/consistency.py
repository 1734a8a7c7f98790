"""Which poses of which links can be right together: hypotheses that agree join scans into components.

Links that were tried and deny a join speak against it. The surest join is made first, so that what a wrong link says
meets what many right ones have said before; and none is made where scans that it brings together contradict each other.
What is disputed is taken off again (``disputes``).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from fmr_cli.multiway.claims import (
    AGREE,
    CLEAR,
    ENOUGH,
    Claim,
    agreement,
    chance_of,
    claims,
    contradicted,
    lenient,
    telling,
)  # fmt: skip
from fmr_cli.multiway.components import Component, Join
from fmr_cli.multiway.denials import Denials, denials
from fmr_cli.multiway.disputes import undisputed
from fmr_cli.multiway.links import Link
from fmr_cli.multiway.looks import displacement
from fmr_cli.multiway.visibility import Seen, total

RIVALS = 3  # poses of a join that are weighed against each other
STAYS = 0.3  # chance, assumed, that a pair that is tried from a wrong pose, of places that look alike, ends there again
HOPELESS = -10.0  # log odds at which no more is asked that could speak against a join
MET = 10  # pairs of scans of two components whose views are compared before these are joined
FLAGRANT = 4.0  # times what contradicts a pose, of one such pair alone, forbid a join; of all together, once


def joined(
    count: int,
    links: list[Link],
    moments: dict[int, np.ndarray],
    overlap: Callable[[int, int, np.ndarray], float],
    fixed: Component | None = None,
    seen: Callable[[list[tuple[int, int, np.ndarray]]], list[Seen]] = lambda pairs: [],
) -> tuple[list[Component], dict[tuple[int, int], Join]]:
    """Components of ``count`` scans, largest first, and the best join of each two that stay apart, by their places.

    overlap: of two scans (source, target) at a pose. fixed: scans whose poses are given. seen: what the views of some
    pairs say, each (source, target, pose).
    """
    components = {i: Component({i: np.eye(4)}) for i in range(count)}
    home = list(range(count))
    if fixed and fixed.T_component_scan:
        first = min(fixed.T_component_scan)
        for i in fixed.T_component_scan:
            del components[i]
            home[i] = first
        components[first] = Component(dict(fixed.T_component_scan), set(fixed.held))
    scans = telling(links)
    chance = chance_of(links, scans)
    against = denials(links, moments, overlap, scans)
    between: dict[tuple[int, int], list[Claim]] = defaultdict(list)
    for claim in claims(links, moments, scans, chance):
        a, b = sorted((home[links[claim.link].source], home[links[claim.link].target]))
        if a != b:
            between[a, b].append(claim)
    silent: dict[tuple[int, int], list[int]] = defaultdict(list)  # links, by number: for denials
    for number, link in enumerate(links):
        a, b = sorted((home[link.source], home[link.target]))
        ruled_out = link.hypotheses and all(contradicted(h, link.source in scans) for h in link.hypotheses)
        if a != b and link.status != "failed" and not ruled_out:
            silent[a, b].append(number)

    refused: list[Join] = []

    def rivals(key: tuple[int, int], exact: bool) -> list[Join]:
        if not between[key]:
            return []
        tried = silent[key] if exact else []
        one, two = (components[n] for n in key)
        return joins_between(one, two, links, between[key], tried, moments, overlap, against, chance)

    def views(key: tuple[int, int], join: Join) -> list[Seen]:
        one, two = (components[n] for n in key)
        return seen(meeting(one, two, join.T_second_first, scans, moments))

    def judged(key: tuple[int, int]) -> list[Join]:
        """The rivals that views allow; the others are refused for good, since components only grow."""
        scans_of_both = components[key[0]].T_component_scan.keys() | components[key[1]].T_component_scan.keys()
        if any(link.start == "known" and scans_of_both.issuperset(link.ends) for link in links):  # whatever views say
            return rivals(key, exact=True)
        for join in rivals(key, exact=True):
            if forbidden(met := views(key, join)):
                refused.append(replace(join, denied=join.denied + len(met)))
                between[key] = [claim for claim in between[key] if claim.link not in join.links]
        return [replace(x, sound=x.sound or vouched(views(key, x))) for x in rivals(key, exact=True)]

    # Denials and views are dear to work out and can but lower a join's odds: only for the join whose turn it is.
    joins = {key: found[0] for key in between if (found := rivals(key, exact=False))}
    exact: set[tuple[int, int]] = set()
    while True:
        hopeful = [
            (join.log_odds, -key[0], -key[1])
            for key, join in joins.items()
            if (join.holds if key in exact else join.log_odds > 0)
        ]
        if not hopeful:
            break
        _, a, b = max(hopeful)
        a, b = -a, -b
        if (a, b) not in exact:
            del joins[a, b]
            for join in judged((a, b))[:1]:
                joins[a, b] = join
            exact.add((a, b))
            continue
        T = joins[a, b].T_second_first
        if components[b].held or (
            not components[a].held and len(components[b].T_component_scan) > len(components[a].T_component_scan)
        ):
            keep, gone, T_keep_gone = b, a, T
        else:
            keep, gone, T_keep_gone = a, b, np.linalg.inv(T)
        for i, pose in components[gone].T_component_scan.items():
            components[keep].T_component_scan[i] = T_keep_gone @ pose
        del components[gone], joins[a, b], between[a, b]
        rekeyed(between, gone, keep)
        rekeyed(silent, gone, keep)
        for key in [k for k in joins if gone in k]:
            del joins[key]
        exact = {k for k in exact if keep not in k and gone not in k}
        joins.update({key: found[0] for key in between if keep in key and (found := rivals(key, exact=False))})
    kept: list[Component] = []
    forbidden_links = {n for join in refused for n in join.links}
    for component in components.values():
        pieces, disputed = undisputed(component, links, moments, scans, forbidden_links)
        kept += pieces
        refused += disputed
    order = sorted(kept, key=lambda c: (-len(c.T_component_scan), min(c.T_component_scan)))
    place = {n: k for k, c in enumerate(order) for n in c.T_component_scan}
    left: dict[tuple[int, int], Join] = {}
    for join in [*joins.values(), *refused]:
        i, j = links[join.links[0]].ends
        ends = min(place[i], place[j]), max(place[i], place[j])
        if place[i] != place[j] and (ends not in left or join.log_odds > left[ends].log_odds):
            left[ends] = join
    return order, left


def forbidden(seen: list[Seen]) -> bool:
    """Whether scans that a join brings together see through each other, one pair or all pairs together."""
    return bool(seen) and (total(seen).seen_through >= 1 or max(x.seen_through for x in seen) >= FLAGRANT)


def vouched(seen: list[Seen]) -> bool:
    """Whether scans that a join brings together see much of the same there, and hardly through each other."""
    every = total(seen)
    return every.agreeing >= ENOUGH and every.seen_through < CLEAR


def meeting(
    first: Component, second: Component, T_second_first: np.ndarray, scans: set[int], moments: dict[int, np.ndarray]
) -> list[tuple[int, int, np.ndarray]]:
    """Pairs of two components at a join, each (source, target, pose), that lie closest for their size; of ``scans``."""
    pairs = []
    for i in sorted(scans & first.T_component_scan.keys()):
        for j in sorted(scans & second.T_component_scan.keys()):
            T = np.linalg.inv(second.T_component_scan[j]) @ T_second_first @ first.T_component_scan[i]
            size = np.sqrt(np.trace(moments[i][:3, :3])) + np.sqrt(np.trace(moments[j][:3, :3]))
            pairs.append((float(np.linalg.norm(T[:3, 3]) / size), i, j, T))
    return [(i, j, T) for near, i, j, T in sorted(pairs, key=lambda p: p[:3])[:MET] if near < 1]


def rekeyed(table: dict[tuple[int, int], list[Any]], gone: int, keep: int) -> None:
    """Moves what lies between ``gone`` and others to ``keep``."""
    for key in [k for k in table if gone in k]:
        other = key[0] if key[1] == gone else key[1]
        if other != keep:
            table[min(keep, other), max(keep, other)].extend(table[key])
        del table[key]


def joins_between(
    first: Component,
    second: Component,
    links: list[Link],
    some: Iterable[Claim],
    tried: list[int],
    moments: dict[int, np.ndarray],
    overlap: Callable[[int, int, np.ndarray], float],
    against: Denials,
    chance: float,
) -> list[Join]:
    """The poses between two components that most speaks for, best first; they share the probability.

    some: the claims between the two; tried: links between them that may deny it, those that found nothing too;
    against: what they say then, as of ``denials``. Doubtful links add nothing to each other, unless views have judged
    them: where two places resemble each other, all links between them are wrong in the same way. Those that are
    likelier wrong than right deny even what they agree with: of a right join, pairs that overlap much are found.
    """
    inside = first.T_component_scan.keys() | second.T_component_scan.keys()
    odds = {(c.link, c.choice): c.odds(inside) for c in some}
    ranked = sorted(some, key=lambda c: (-odds[c.link, c.choice], c.link, c.choice))
    T_join = np.stack([implied(first, second, links[c.link], c.choice) for c in ranked])  # second <- first
    reach = AGREE * lenient(len(inside))
    best: list[Join] = []
    taken = np.zeros(len(ranked), bool)
    for lead in range(len(ranked)):
        if taken[lead] or len(best) == RIVALS:
            continue
        agreed: dict[int, Claim] = {}
        apart = np.zeros(len(ranked))  # sums of displacements between poses that agree with the lead
        for k, claim in enumerate(ranked):
            link = links[claim.link]
            scan = link.source if link.source in first.T_component_scan else link.target
            pose = first.T_component_scan[scan]
            off = displacement(T_join @ pose, T_join[k] @ pose, moments[scan])
            if off[lead] < reach * link.edge:
                taken[k] = True
                apart += np.minimum(off, reach * link.edge)
                agreed.setdefault(claim.link, claim)
        T_agreed = T_join[int(apart.argmin())]  # the pose in their middle: the lead may be a little wrong
        score = odds[ranked[lead].link, ranked[lead].choice]
        sound = any(claim.sound for claim in agreed.values())
        for n, claim in agreed.items():
            if n != ranked[lead].link and (claim.told or (sound and claim.likely)):
                score += agreement(claim.log_odds, chance if links[n].start != "pose" else max(chance, STAYS))
        denied = 0
        for number in [n for n in tried if n not in agreed or not (agreed[n].told or agreed[n].likely)]:
            i, j = links[number].ends
            A, B = (first, second) if i in first.T_component_scan else (second, first)
            T = T_agreed if A is first else np.linalg.inv(T_agreed)
            T_ji = np.linalg.inv(B.T_component_scan[j]) @ T @ A.T_component_scan[i]
            penalty = against.of(links[number], overlap(i, j, T_ji), T_ji, moments[i])
            denied += penalty > 0
            score -= penalty
            if score < HOPELESS:
                break
        best.append(Join(T_agreed, score, 0.0, 0.0, tuple(sorted(agreed)), denied, sound))
    best.sort(key=lambda join: -join.log_odds)
    weights = np.exp(np.clip([join.log_odds for join in best], -50, 50))
    every = 1 + float(weights.sum())
    return [
        replace(join, probability=float(w) / every, against=float(np.delete(weights, n).max(initial=0.0)) / every)
        for n, (join, w) in enumerate(zip(best, weights, strict=True))
    ]


def implied(first: Component, second: Component, link: Link, choice: int) -> np.ndarray:
    """The pose first -> second component that one hypothesis says."""
    T = link.hypotheses[choice].T_target_source
    if link.source in first.T_component_scan:
        return second.T_component_scan[link.target] @ T @ np.linalg.inv(first.T_component_scan[link.source])
    return np.linalg.inv(
        first.T_component_scan[link.target] @ T @ np.linalg.inv(second.T_component_scan[link.source])
    )  # fmt: skip
