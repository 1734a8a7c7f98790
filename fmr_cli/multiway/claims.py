"""What each pose of each link claims: its odds by itself, by the scans' views, and by the triangles that it closes.

Each hypothesis comes with the odds that ``align`` gives it. Those at which one scan contradicts the other one's view
are out. Others that agree, directly or round a cycle, speak for each other, as far as wrong ones hardly ever agree. How
often they do is told by how many of ``align``'s sure poses the views contradict: rooms that resemble each other do so
for every scan in them (perceptual aliasing).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Iterable
from dataclasses import dataclass

import numpy as np

from fmr_cli.multiway.links import Hypothesis, Link
from fmr_cli.multiway.looks import displacement
from fmr_cli.multiway.visibility import NO_PLACE, Seen, doubt, from_one_place

AGREE = 4.0  # voxel edges, root mean square over a scan, that poses of one link or cycle may differ by
CHANCE = 0.05  # that a wrong hypothesis agrees with another one, at least
# Of 340 poses that ``align`` has found wrongly on the building of `python -m benchmarks.multiway` none has a
# contradiction below 1.2; of the right ones half are below 0.1.
CONFIRMS, ENOUGH = 4.6, 800  # log odds that views add to a pose that they find nothing against; points that must agree
CLEAR = 0.5  # contradiction below which so many points confirm a pose
UNLIKELY = 0.01  # confidence of a hypothesis, below which it speaks for nothing
LEAST_CONFIDENT = 0.1  # of a hypothesis that counts once the network agrees with it
SURE = 4.6  # log odds, at most, that ``align`` gives a hypothesis: of scans of a new kind it may misjudge one in 100
CERTAIN = 12.0  # log odds of a link that is given, and at most of all triangles over one hypothesis


@dataclass(frozen=True)
class Claim:
    """One hypothesis of one link. log_odds: of its own; support: scan by scan, what the triangle over it adds.

    sound: ``align`` is sure of it, or views confirm it; told: views have judged it.
    """

    link: int
    choice: int
    log_odds: float
    sound: bool
    told: bool
    support: dict[int, float]

    @property
    def likely(self) -> bool:
        """Whether it is likelier right than wrong."""
        return self.log_odds > 0

    def odds(self, inside: Container[int]) -> float:
        """With triangles over scans that are not ``inside`` what is joined: links to those are claims themselves."""
        return self.log_odds + min(sum(x for k, x in self.support.items() if k not in inside), CERTAIN)


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
    clear = h.seen is not None and h.seen.agreeing >= ENOUGH and h.seen.contradiction < CLEAR
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
        told = link.source in scans
        found.append(Claim(number, choice, odds, h.aligned or confirmed(h, told), told, support))
    return found


def lenient(scans: int) -> float:
    """How many times AGREE poses may differ by across so many scans: they drift along chains."""
    return 1 + 0.1 * float(np.sqrt(scans))


def agreeing(
    link: Link, T_component_scan: dict[int, np.ndarray], moment: np.ndarray, one_place: bool
) -> dict[int, float]:
    """The hypotheses of a link that agree with a component's poses, by number, and how far each is from them.

    moment (4, 4): of its source. one_place: whether views tell.
    """
    expected = np.linalg.inv(T_component_scan[link.target]) @ T_component_scan[link.source]
    if not link.hypotheses:
        return {}
    off = displacement(np.stack([h.T_target_source for h in link.hypotheses]), expected, moment)
    near = off <= AGREE * lenient(len(T_component_scan)) * link.edge
    return {
        k: float(off[k]) for k, h in enumerate(link.hypotheses)
        if near[k] and h.confidence >= LEAST_CONFIDENT and not contradicted(h, one_place)
    }  # fmt: skip
