"""Which poses of which links can be right together: hypotheses that agree join scans into components.

Each hypothesis comes with the odds that ``align`` gives it. Those at which one scan contradicts the other one's view
are out. Others that agree, directly or round a cycle, speak for each other, as far as wrong ones hardly ever agree. How
often they do is told by how many of ``align``'s sure poses the views contradict: rooms that resemble each other do so
for every scan in them (perceptual aliasing). Links that were tried and deny a join speak against it. The surest join is
made first, so that what a wrong link says meets what many right ones have said before; and none is made where scans
that it brings together contradict each other.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmr_cli.multiway.links import Hypothesis, Link
from fmr_cli.multiway.looks import displacement
from fmr_cli.multiway.visibility import NO_PLACE, Seen, doubt, from_one_place, total

AGREE = 4.0  # voxel edges, root mean square over a scan, that poses of one link or cycle may differ by
CHANCE = 0.05  # that a wrong hypothesis agrees with another one, at least
# Of 340 poses that ``align`` has found wrongly on the building of `python -m benchmarks.multiway` none has a
# contradiction below 1.2; of the right ones half are below 0.1.
CONFIRMS, ENOUGH = 4.6, 800  # log odds that views add to a pose that they find nothing against; points that must agree
UNLIKELY = 0.01  # confidence of a hypothesis, below which it speaks for nothing
JOINED = 0.5  # probability from which scans are joined, if one link is aligned by itself
DOUBTFUL = 0.9  # the same where none is, but several agree: two rooms that resemble each other agree in a doubtful way
DENIALS = (
    (0.5, 3.0),
    (0.3, 1.0),
)  # at so much overlap a link that found nothing is e^-x as likely if the join is right
RIVALS, DENIERS = 3, 12  # poses of a join that are weighed against each other, and links that may deny each
MET = 10  # pairs of scans of two components whose views are compared before these are joined
FLAGRANT = 4.0  # times what contradicts a pose, of one such pair alone, forbid a join; of all together, once
SURE = 4.6  # log odds, at most, that ``align`` gives a hypothesis: of scans of a new kind it may misjudge one in 100
CERTAIN = 12.0  # log odds of a link that is given, and at most of all triangles over one hypothesis


@dataclass
class Component:
    """Scans with one frame. T_component_scan: by scan, between centred frames. held: scans that don't move."""

    T_component_scan: dict[int, np.ndarray]
    held: set[int] = field(default_factory=set)


@dataclass(frozen=True)
class Join:
    """A pose between two components. probability: that it is right; against: the probability of the best rival.

    links: that agree on it, by number; sound: one is aligned by itself; denied: how many deny it.
    """

    T_second_first: np.ndarray
    log_odds: float
    probability: float
    against: float
    links: tuple[int, ...]
    denied: int
    sound: bool

    @property
    def holds(self) -> bool:
        """Whether scans are joined by it: a doubtful link never does so alone, nor do several that leave a doubt."""
        if self.sound:
            return self.probability >= JOINED
        return len(self.links) > 1 and self.probability >= DOUBTFUL


@dataclass(frozen=True)
class Claim:
    """One hypothesis of one link. log_odds: of its own; support: scan by scan, what the triangle over it adds.

    sound: ``align`` is sure of it, or views confirm it.
    """

    link: int
    choice: int
    log_odds: float
    sound: bool
    support: dict[int, float]

    def odds(self, *components: Component) -> float:
        """With triangles over scans outside the components: links to those inside are claims of the join themselves."""
        outside = (x for k, x in self.support.items() if not any(k in c.T_component_scan for c in components))
        return self.log_odds + min(sum(outside), CERTAIN)


def log_odds(h: Hypothesis, one_place: bool) -> float:
    """Of one hypothesis: what ``align`` says, less what views say against it, where they tell anything."""
    if h.confidence == 1:  # given
        return CERTAIN
    c = max(h.confidence, 1e-9)
    views = support(h.seen) - doubt(h.seen) if one_place else 0.0
    return min(float(np.log(c / (1 - c))) + views, SURE)


def support(seen: Seen | None) -> float:
    """What views that find next to nothing against a pose add to its log odds, where they have enough to say."""
    return CONFIRMS * max(1 - seen.contradiction**2, 0.0) * min(seen.agreeing / ENOUGH, 1.0) if seen else 0.0


def confirmed(h: Hypothesis, one_place: bool) -> bool:
    """Whether views alone make a pose sound that ``align`` is not sure of: so many points, so little against it."""
    clear = h.seen is not None and h.seen.agreeing >= ENOUGH and h.seen.contradiction < 0.5
    return one_place and h.firm and clear


def contradicted(h: Hypothesis, one_place: bool) -> bool:
    """Whether views rule a hypothesis out."""
    return one_place and h.seen is not None and h.seen.contradiction >= 1


def telling(links: Iterable[Link]) -> set[int]:
    """The scans whose views tell right poses from wrong ones, by their links.

    A scan that no sure link has judged yet is one of them if it was tried against one and a viewpoint explains it.
    """
    tried = [(x.ends, h) for x in links if x.start != "known" for h in x.hypotheses if h.seen is not None]
    sure = [(ends, h.seen) for ends, h in tried if h.aligned and h.seen is not None]
    scans, judged = from_one_place(sure), {n for ends, _ in sure for n in ends}
    explained = {ends for ends, h in tried if h.seen is not None and h.seen.hidden <= NO_PLACE}
    return scans | {n for ends in explained if scans.intersection(ends) for n in ends if n not in judged}


def chance_of(links: Iterable[Link], scans: set[int]) -> float:
    """That a wrong hypothesis agrees with another one: the share of ``align``'s sure poses that views rule out."""
    ruled_out = [contradicted(h, True) for x in links if x.source in scans for h in x.hypotheses if h.aligned]
    return max(float(np.mean(ruled_out)) if ruled_out else 0.0, CHANCE)


def agreement(log_odds: float, chance: float) -> float:
    """What a hypothesis of those odds adds to the log odds of another one that it agrees with.

    By Bayes' rule: P(agrees | right) / P(agrees | wrong), where it agrees if it is right, or by chance.
    """
    return float(np.logaddexp(0.0, log_odds - np.log(chance)))


def both(a: float, b: float) -> float:
    """The log odds that two hypotheses are right, from those of each."""
    return -float(np.logaddexp(np.logaddexp(-a, -b), -a - b))


def claims(links: list[Link], moments: dict[int, np.ndarray], scans: set[int], chance: float) -> list[Claim]:
    """Every hypothesis that may be right, with what it says by itself and what each triangle that it closes adds."""
    poses: dict[tuple[int, int], list[tuple[np.ndarray, float, float]]] = defaultdict(
        list
    )  # T_second_first, odds, edge
    near: dict[int, set[int]] = defaultdict(set)
    own = []
    for number, link in enumerate(links):
        i, j = link.ends
        for choice, h in enumerate(link.hypotheses):
            if h.confidence < UNLIKELY or contradicted(h, link.source in scans):
                continue
            odds = log_odds(h, link.source in scans)
            own.append((number, choice, odds))
            poses[i, j].append((h.T_target_source, odds, link.edge))
            poses[j, i].append((np.linalg.inv(h.T_target_source), odds, link.edge))
            near[i].add(j)
            near[j].add(i)
    found = []
    for number, choice, odds in own:
        link, h = links[number], links[number].hypotheses[choice]
        i, j = link.ends
        support = {}
        for k in sorted(near[i] & near[j]):
            best = 0.0
            for T_ki, a, edge_a in poses[i, k]:
                for T_jk, b, edge_b in poses[k, j]:
                    reach = AGREE * 1.5 * max(link.edge, edge_a, edge_b)
                    if displacement(T_jk @ T_ki, h.T_target_source, moments[i]) < reach:
                        best = max(best, agreement(both(a, b), chance))
            if best:
                support[k] = best
        found.append(Claim(number, choice, odds, h.aligned or confirmed(h, link.source in scans), support))
    return found


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
        tried = silent[key] if exact else []
        one, two = (components[n] for n in key)
        return joins_between(one, two, links, between[key], tried, moments, overlap, chance) if between[key] else []

    def without_forbidden(key: tuple[int, int]) -> list[Join]:
        """The rivals that views allow; the others are refused for good, since components only grow."""
        one, two = (components[n] for n in key)
        scans_of_both = one.T_component_scan.keys() | two.T_component_scan.keys()
        if any(link.start == "known" and scans_of_both.issuperset(link.ends) for link in links):  # whatever views say
            return rivals(key, exact=True)
        for join in rivals(key, exact=True):
            met = meeting(one, two, join.T_second_first, scans, moments)
            if forbidden(seen(met)):
                refused.append(replace(join, denied=join.denied + len(met)))
                between[key] = [claim for claim in between[key] if claim.link not in join.links]
        return rivals(key, exact=True)

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
            for join in without_forbidden((a, b))[:1]:
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
    order = sorted(components.values(), key=lambda c: (-len(c.T_component_scan), min(c.T_component_scan)))
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
    chance: float = CHANCE,
) -> list[Join]:
    """The poses between two components that most speaks for, best first; they share the probability.

    some: the claims between the two; tried: links between them that may deny it, those that found nothing too.
    """
    odds = {(c.link, c.choice): c.odds(first, second) for c in some}
    ranked = sorted(some, key=lambda c: (-odds[c.link, c.choice], c.link, c.choice))
    T_join = np.stack([implied(first, second, links[c.link], c.choice) for c in ranked])  # second <- first
    lenient = 1 + 0.1 * np.sqrt(len(first.T_component_scan) + len(second.T_component_scan))  # poses drift along chains
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
            if off[lead] < AGREE * lenient * link.edge:
                taken[k] = True
                apart += np.minimum(off, AGREE * lenient * link.edge)
                agreed.setdefault(claim.link, claim)
        T_agreed = T_join[int(apart.argmin())]  # the pose in their middle: the lead may be a little wrong
        score = odds[ranked[lead].link, ranked[lead].choice]
        score += sum(agreement(c.log_odds, chance) for n, c in agreed.items() if n != ranked[lead].link)
        denied = 0
        for number in [n for n in tried if n not in agreed][:DENIERS]:
            i, j = links[number].ends
            A, B = (first, second) if i in first.T_component_scan else (second, first)
            T = T_agreed if A is first else np.linalg.inv(T_agreed)
            shared = overlap(i, j, np.linalg.inv(B.T_component_scan[j]) @ T @ A.T_component_scan[i])
            penalty = next((x for least, x in DENIALS if shared >= least), 0.0)
            denied += penalty > 0
            score -= penalty
        sound = any(claim.sound for claim in agreed.values())
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
