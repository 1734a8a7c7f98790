"""Which poses of which links can be right together: hypotheses that agree join scans into components.

Each hypothesis comes with the odds that ``align`` gives it. Hypotheses that agree, directly or round a cycle, speak for
each other, since wrong ones hardly ever agree; links that were tried and deny a join speak against it. The surest join
is made first, so that what a wrong link says meets what many right ones have said before.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmr_cli.multiway.links import Hypothesis, Link
from fmr_cli.multiway.looks import displacement
from fmr_cli.multiway.visibility import CONTRADICTED, ONE_PLACE, doubt, from_one_place

AGREE = 4.0  # voxel edges, root mean square over a scan, that poses of one link or cycle may differ by
CHANCE = 0.05  # that a wrong hypothesis agrees with another by accident, or since a place repeats itself
JOINED = 0.5  # probability from which scans are joined, if one link is aligned by itself or two agree
DENIALS = (
    (0.5, 3.0),
    (0.3, 1.0),
)  # at so much overlap a link that found nothing is e^-x as likely if the join is right
RIVALS, DENIERS = 3, 12  # poses of a join that are weighed against each other, and links that may deny each
DENIED = 6.0  # log odds that a join loses by each link at whose pose one scan sees through the other
MET = 10  # pairs of scans of two components whose views are compared before these are joined
CERTAIN = 12.0  # log odds, at most, of one hypothesis


@dataclass
class Component:
    """Scans with one frame. T_component_scan: by scan, between centred frames. held: scans that don't move."""

    T_component_scan: dict[int, np.ndarray]
    held: set[int] = field(default_factory=set)


@dataclass(frozen=True)
class Join:
    """A pose between two components. probability: that it is right; against: the probability of the best rival.

    links: that agree on it, by number; sound: one is aligned by itself, or they are two; denied: how many deny it.
    """

    T_second_first: np.ndarray
    log_odds: float
    probability: float
    against: float
    links: tuple[int, ...]
    denied: int
    sound: bool


@dataclass(frozen=True)
class Claim:
    """One hypothesis of one link, with its log odds, cycles included; contradicted: one scan sees through the other."""

    link: int
    choice: int
    log_odds: float
    contradicted: bool = False


def log_odds(h: Hypothesis, one_place: bool) -> float:
    """Of one hypothesis: what ``align`` says, less what one scan sees through at it, where that tells anything."""
    c = min(max(h.confidence, 1e-9), 1 - 1e-9)
    return float(np.clip(np.log(c / (1 - c)), -CERTAIN, CERTAIN)) - (doubt(h.seen_through or 0.0) if one_place else 0.0)


def telling(links: list[Link]) -> set[int]:
    """The scans whose views tell right poses from wrong ones, by their links."""
    seen = [(x.ends, x.hypotheses[0].seen_through or 0.0) for x in links if x.status == "aligned" and x.hypotheses]
    return from_one_place(seen, ONE_PLACE)


def claims(links: list[Link], moments: dict[int, np.ndarray]) -> list[Claim]:
    """Every hypothesis with what it says by itself and what the triangles that it closes add to it."""
    by_scan: dict[int, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for number, link in enumerate(links):
        if link.hypotheses:
            by_scan[link.source][link.target].append(number)
            by_scan[link.target][link.source].append(number)
    scans = telling(links)
    alone = [[log_odds(h, link.source in scans) for h in link.hypotheses] for link in links]
    found = []
    for number, link in enumerate(links):
        i, j = link.ends
        for choice, h in enumerate(link.hypotheses):
            support = 0.0
            for k in sorted(by_scan[i].keys() & by_scan[j].keys()):
                best = 0.0
                for m in by_scan[i][k]:
                    for n in by_scan[k][j]:
                        a, b = links[m], links[n]
                        reach = AGREE * 1.5 * max(link.edge, a.edge, b.edge)
                        T_ki, T_jk = poses_along(a, i, k), poses_along(b, k, j)
                        off = displacement(T_jk[:, None] @ T_ki[None], h.T_target_source, moments[i])
                        odds = np.add.outer(alone[n], alone[m])
                        agreed = np.where(off < reach, odds - np.log(CHANCE), 0.0)
                        best = max(best, float(agreed.max()))
                support += best
            contradicted = link.source in scans and (h.seen_through or 0.0) >= CONTRADICTED
            found.append(Claim(number, choice, alone[number][choice] + min(support, CERTAIN), contradicted))
    return found


def poses_along(link: Link, source: int, target: int) -> np.ndarray:
    """The link's hypotheses as T_target_source (H, 4, 4) in the asked direction."""
    T = np.stack([h.T_target_source for h in link.hypotheses])
    return T if link.ends == (source, target) else np.linalg.inv(T)


def joined(
    count: int,
    links: list[Link],
    moments: dict[int, np.ndarray],
    overlap: Callable[[int, int, np.ndarray], float],
    fixed: Component | None = None,
    seen_through: Callable[[list[tuple[int, int, np.ndarray]]], float] = lambda pairs: 0.0,
) -> tuple[list[Component], dict[tuple[int, int], Join]]:
    """Components of ``count`` scans, largest first, and the best join of each two that stay apart, by their places.

    overlap: of two scans (source, target) at a pose. fixed: scans whose poses are given. seen_through: the share of the
    scans of some pairs, each (source, target, pose), that the other one sees through.
    """
    components = {i: Component({i: np.eye(4)}) for i in range(count)}
    home = list(range(count))
    if fixed and fixed.T_component_scan:
        first = min(fixed.T_component_scan)
        for i in fixed.T_component_scan:
            del components[i]
            home[i] = first
        components[first] = Component(dict(fixed.T_component_scan), set(fixed.held))
    every, scans = claims(links, moments), telling(links)
    between: dict[tuple[int, int], list[Claim]] = defaultdict(list)
    for claim in every:
        a, b = sorted((home[links[claim.link].source], home[links[claim.link].target]))
        if a != b:
            between[a, b].append(claim)
    silent: dict[tuple[int, int], list[int]] = defaultdict(list)  # links, by number: for denials
    speaking = {c.link for c in every if not c.contradicted}
    for number, link in enumerate(links):
        a, b = sorted((home[link.source], home[link.target]))
        if a != b and link.status != "failed" and (number in speaking or not link.hypotheses):
            silent[a, b].append(number)

    def best(key: tuple[int, int], exact: bool) -> Join:
        tried = silent[key] if exact else []
        return best_join(components[key[0]], components[key[1]], links, between[key], tried, moments, overlap)

    # Denials are dear to work out and can but lower a join's odds: only for the join whose turn it is.
    joins = {key: best(key, exact=False) for key in between}
    exact: set[tuple[int, int]] = set()
    while True:
        hopeful = [
            (join.log_odds, -key[0], -key[1])
            for key, join in joins.items()
            if (join.probability >= JOINED and join.sound if key in exact else join.log_odds > 0)
        ]
        if not hopeful:
            break
        _, a, b = max(hopeful)
        a, b = -a, -b
        if (a, b) not in exact:
            joins[a, b] = best((a, b), exact=True)
            exact.add((a, b))
            continue
        T = joins[a, b].T_second_first
        met = meeting(components[a], components[b], T, scans, moments)
        given = any(links[n].start == "known" for n in joins[a, b].links)
        if not given and seen_through(met) > CONTRADICTED:
            joins[a, b] = replace(joins[a, b], denied=joins[a, b].denied + len(met), sound=False)
            continue
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
        joins.update({key: best(key, exact=False) for key in between if keep in key})
    order = sorted(
        components, key=lambda c: (-len(components[c].T_component_scan), min(components[c].T_component_scan))
    )
    place = {c: n for n, c in enumerate(order)}
    left = {(min(place[a], place[b]), max(place[a], place[b])): join for (a, b), join in joins.items()}
    return [components[c] for c in order], left


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


def best_join(
    first: Component,
    second: Component,
    links: list[Link],
    some: Iterable[Claim],
    tried: list[int],
    moments: dict[int, np.ndarray],
    overlap: Callable[[int, int, np.ndarray], float],
) -> Join:
    """The pose between two components that most speaks for; its rivals share the probability.

    some: the claims between the two; tried: links between them that may deny it, those that found nothing too.
    """
    ranked = sorted(some, key=lambda c: (-c.log_odds, c.link, c.choice))
    T_join = np.stack([implied(first, second, links[c.link], c.choice) for c in ranked])  # second <- first
    lenient = 1 + 0.1 * np.sqrt(len(first.T_component_scan) + len(second.T_component_scan))  # poses drift along chains
    best: list[Join] = []
    taken = np.zeros(len(ranked), bool)
    for lead in range(len(ranked)):
        if taken[lead] or len(best) == RIVALS:
            continue
        agreed: dict[int, float] = {}
        contradicted: set[int] = set()
        apart = np.zeros(len(ranked))  # sums of displacements between poses that agree with the lead
        for k, claim in enumerate(ranked):
            link = links[claim.link]
            scan = link.source if link.source in first.T_component_scan else link.target
            pose = first.T_component_scan[scan]
            off = displacement(T_join @ pose, T_join[k] @ pose, moments[scan])
            if off[lead] < AGREE * lenient * link.edge:
                taken[k] = True
                apart += np.minimum(off, AGREE * lenient * link.edge)
                agreed[claim.link] = max(agreed.get(claim.link, -np.inf), claim.log_odds)
                contradicted |= {claim.link} if claim.contradicted else set()
        T_agreed = T_join[int(apart.argmin())]  # the pose in their middle: the lead may be a little wrong
        score = ranked[lead].log_odds
        score += sum(max(x - np.log(CHANCE), 0.0) for n, x in agreed.items() if n != ranked[lead].link)
        denied = len(contradicted)
        score -= DENIED * denied
        for number in [n for n in tried if n not in agreed][:DENIERS]:
            i, j = links[number].ends
            A, B = (first, second) if i in first.T_component_scan else (second, first)
            T = T_agreed if A is first else np.linalg.inv(T_agreed)
            shared = overlap(i, j, np.linalg.inv(B.T_component_scan[j]) @ T @ A.T_component_scan[i])
            penalty = next((x for least, x in DENIALS if shared >= least), 0.0)
            denied += penalty > 0
            score -= penalty
        sound = len(agreed) > 1 or links[ranked[lead].link].status == "aligned"
        best.append(Join(T_agreed, score, 0.0, 0.0, tuple(sorted(agreed)), denied, sound))
    odds = np.exp(np.clip([join.log_odds for join in best], -50, 50))
    top = int(odds.argmax())
    rest = float(np.delete(odds, top).max()) if len(odds) > 1 else 0.0
    total = 1 + float(odds.sum())
    return replace(best[top], probability=float(odds[top]) / total, against=rest / total)


def implied(first: Component, second: Component, link: Link, choice: int) -> np.ndarray:
    """The pose first -> second component that one hypothesis says."""
    T = link.hypotheses[choice].T_target_source
    if link.source in first.T_component_scan:
        return second.T_component_scan[link.target] @ T @ np.linalg.inv(first.T_component_scan[link.source])
    return np.linalg.inv(
        first.T_component_scan[link.target] @ T @ np.linalg.inv(second.T_component_scan[link.source])
    )  # fmt: skip
