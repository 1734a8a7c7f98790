"""The rounds of registering, dearer from one to the next; none more once the network is well connected.

A round is fixed by what is known when it begins and ends when all its pairs are done, so that nothing depends on which
worker was first.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.multiway.candidates import alike_first, leading_out, untried
from fmr_cli.multiway.components import Component
from fmr_cli.multiway.parts import in_triangles
from fmr_cli.multiway.registering import Attempt, attempt, from_look, register_all
from fmr_cli.multiway.survey import Ends, Survey, ends_of, nearest_pairs

FIRST, NEXT = 3, 3  # promising pairs of a scan that are registered in the first round, of a component in each later one
MANY, FIRST_OF_MANY = 50, 2  # scans from which rounds of joining are cheaper than a third pair for each at once
NEAR = 16  # scans next to one in the network that may confirm where it is
ROUNDS, IDLE = 12, 3  # of joining components, at most; of them in a row that join nothing, after which more seldom do
CONFIRMED = 3  # links of a scan that stop the search for more
SHARED = 0.3  # overlap at the network's poses from which an untried pair is worth registering
ROUND_TRIP = 4  # links between two scans that overlap, from which one between them is worth it whatever they have
DEAR, DEAR_IN_ALL = 2, 12  # pairs of a component that the dear starts are tried on; of few components, more of each
DEAR_SHARE = 0.5  # of all scans: so many pairs, at most


def register_most_promising(survey: Survey) -> None:
    """Each scan's most promising pairs, and those whose known poses say that they overlap."""
    taken: dict[int, int] = {}
    chosen: set[Ends] = set()
    first = FIRST if len(survey.edges) < MANY else FIRST_OF_MANY
    for pair in untried(survey, "look"):
        if any(taken.get(n, 0) < first for n in pair):
            chosen.add(pair)
            taken.update({n: taken.get(n, 0) + 1 for n in pair})
    attempts = [from_look(survey, *pair) for pair in sorted(chosen)]
    posed = sorted(survey.poses.keys() & survey.edges.keys())
    for n in posed:
        for m in (k for k in posed if k < n and (n, k) not in chosen and survey.possible(n, k)):
            T, slack = survey.predicted(n, m)
            if slack < 10 * survey.edges[n] and survey.overlap(n, m, T) >= SHARED:
                attempts.append(attempt(survey, n, m, "pose", T))
    register_all(survey, attempts)


def join_components(survey: Survey) -> None:
    """The most promising pairs that lead out of each component, until one is left or none is promising."""
    fewest, idle = len(survey.components), 0
    for _ in range(ROUNDS):
        chosen = leading_out(survey, untried(survey, "look"), NEXT)
        if len(survey.components) == 1 or not chosen or idle == IDLE:
            return
        register_all(survey, [from_look(survey, *pair) for pair in sorted(chosen)])
        idle = 0 if len(survey.components) < fewest else idle + 1
        fewest = min(fewest, len(survey.components))


def confirm(survey: Survey) -> None:
    """Pairs that overlap at the network's poses: for scans with few links, round trips, and links that stand alone."""
    for _ in range(2):
        attempts = [task for component in survey.components for task in worth_confirming(survey, component)]
        if not attempts:
            return
        register_all(survey, sorted(attempts, key=lambda task: (task.source, task.target)))


def worth_confirming(survey: Survey, component: Component) -> list[Attempt]:
    """At most two pairs a scan of a component, those that share most first."""
    poses = component.T_component_scan
    members = sorted(poses)
    near = aligned_with(survey, members)
    steps = links_between(near)
    beside = beside_lone_links(near)
    found = []
    for i, j in nearest_pairs(poses, NEAR):
        few = min(len(near[i]), len(near[j])) < CONFIRMED or steps.get((i, j), ROUND_TRIP) >= ROUND_TRIP
        if (few or (i, j) in beside) and (i, j) not in survey.links and survey.possible(i, j):
            T = np.linalg.inv(poses[j]) @ poses[i]
            shared = survey.overlap(i, j, T)
            if shared >= SHARED:
                found.append((-shared, i, j, T))
    count: dict[int, int] = {}
    chosen = []
    for _, i, j, T in sorted(found, key=lambda x: x[:3]):
        if min(count.get(i, 0), count.get(j, 0)) < 2:
            chosen.append(attempt(survey, i, j, "pose", T))
            count[i], count[j] = count.get(i, 0) + 1, count.get(j, 0) + 1
    return chosen


def aligned_with(survey: Survey, members: list[int]) -> dict[int, set[int]]:
    """By scan of a component, those that aligned links join it to."""
    near: dict[int, set[int]] = {n: set() for n in members}
    for (i, j), link in survey.links.items():
        if link.status == "aligned" and i in near and j in near:
            near[i].add(j)
            near[j].add(i)
    return near


def links_between(near: dict[int, set[int]]) -> dict[Ends, int]:
    """How many aligned links lie between scans, where fewer than ROUND_TRIP."""
    found = {}
    for n in near:
        seen, front = {n}, {n}
        for step in range(1, ROUND_TRIP):
            front = {m for k in front for m in near[k]} - seen
            seen |= front
            found.update({(n, m): step for m in front})
    return found


def beside_lone_links(near: dict[int, set[int]]) -> set[Ends]:
    """Pairs of a scan, or one next to it, at either end of an aligned link that no third scan confirms.

    Such a link may be wrong and join places that resemble each other; then these pairs overlap there but don't fit.
    """
    confirmed = in_triangles(near)
    lone = [(i, j) for i in near for j in near[i] - confirmed[i] if i < j]
    return {ends_of(a, b) for i, j in lone for a in {i} | near[i] for b in {j} | near[j] if a != b}


def try_dear_starts(survey: Survey) -> bool:
    """For scans that are still apart, ``align`` as it is for a pair alone, on the few pairs that most resemble."""
    if len(survey.components) == 1:
        return False
    most = max(DEAR, DEAR_IN_ALL // len(survey.components))
    pairs = leading_out(survey, alike_first(survey, untried(survey, "auto", -np.inf)), most)
    pairs = pairs[: max(2, int(DEAR_SHARE * len(survey.edges)))]
    register_all(survey, [attempt(survey, *pair, "auto") for pair in sorted(pairs)])
    return bool(pairs)
