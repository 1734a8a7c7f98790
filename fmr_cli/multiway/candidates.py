"""Which pairs of scans are worth registering: a cheap look at each of those that resemble each other."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from fmr_cli.multiway import claims, looks, planes, visibility
from fmr_cli.multiway.looks import Look
from fmr_cli.multiway.survey import Ends, Survey, ends_of
from fmr_cli.multiway.visibility import Seen

FEW_PAIRS = 1_200  # of which every one is looked at: all of 49 scans
NEIGHBOURS = 8  # that most resemble a scan as places, looked at at a time where there are more pairs than that
PORTIONS = 4  # of so many neighbours, at most, for scans that are still apart
PROMISING = 0.15  # a look's promise from which a pair is worth registering: pairs without overlap hardly reach it
# As visibility.ONE_PLACE; and the contradiction that a look's rough pose may have though it is right, one sigma. On the
# building of `python -m benchmarks.multiway` half of the right ones have less than 0.3, 90 % less than 3; of the wrong
# ones 1 % have less than 3.5, 95 % more than 4.3.
ROUGHLY_ONE_PLACE, ROUGHLY = 1.0, 2.0
HOPELESS = 0.05  # of a few points, beyond which the other scan sees: of right poses 95 % have less
CLOSER = 500  # points of each scan whose views are compared where it is less
IN_VAIN = 0.3  # trust that a few points leave, from which all are asked
PLANES = 2.0  # promise of a pose by planes, times what coincides: that of one on which four features agree


def look_at_pairs(survey: Survey) -> None:
    """A cheap look at every pair where they are few, else at those that most resemble each other as places."""
    numbers = sorted(survey.edges)
    if len(numbers) * (len(numbers) - 1) <= 2 * FEW_PAIRS:
        look_at(survey, [(j, i) for n, i in enumerate(numbers) for j in numbers[n + 1 :] if survey.possible(j, i)])
    else:
        with survey.stage("look"):
            orders = (-survey.similarity).argsort(axis=1, kind="stable")
            survey.alike = {i: [numbers[k] for k in orders[row] if k != row] for row, i in enumerate(numbers)}
        look_further(survey)


def look_further(survey: Survey) -> bool:
    """Looks at the next NEIGHBOURS of each scan that is not in the largest component; False if there are none left."""
    largest = survey.components[0].T_component_scan if survey.components else {}
    settled = largest if len(largest) > 1 else {}
    pairs: set[Ends] = set()
    for i in sorted(survey.alike.keys() - settled.keys()):
        for j in survey.alike[i][:NEIGHBOURS]:
            pair = ends_of(i, j)
            if pair not in survey.looks and survey.possible(*pair):
                pairs.add(pair)
        del survey.alike[i][:NEIGHBOURS]
    look_at(survey, sorted(pairs))
    return bool(pairs)


def look_by_planes(survey: Survey, most: float) -> bool:
    """Looks once more, by planes, at pairs of different components, one of ``most`` scans; False if none are left.

    Of so many poses, most of them wrong, views have to tell the right ones: of scans taken from one place each.
    """
    size = {n: len(c.T_component_scan) for c in survey.components for n in c.T_component_scan}
    home = {n: k for k, c in enumerate(survey.components) for n in c.T_component_scan}
    telling = claims.telling(survey.links.values())
    if not telling:
        return False
    scans = telling | {n for n in home if not linked(survey, n)}
    scans = {n for n in scans if survey.description(n).directions is not None}
    with survey.stage("see through"):
        survey.each("finding viewpoints", survey.viewed, sorted(scans))
    scans = {n for n in scans if survey.viewed(n).hidden <= visibility.NO_PLACE}
    pairs = [
        p for p in sorted(survey.looks.keys() - survey.looked_by_planes)
        if scans.issuperset(p) and home[p[0]] != home[p[1]] and min(size[n] for n in p) <= most
    ]  # fmt: skip
    with survey.stage("look by planes"):
        found = survey.each("looking", lambda p: by_planes(survey, p), pairs)
    for pair, more in zip(pairs, found, strict=True):
        survey.looks[pair] = looks.best_of([*every(survey.looks[pair]), *more])
    survey.looked_by_planes.update(pairs)
    return bool(pairs)


def by_planes(survey: Survey, pair: Ends) -> list[Look]:
    """Poses at which planes of two scans meet, and neither sees through the other."""
    a, b = (survey.viewed(n) for n in pair)
    one, two = (survey.description(n) for n in pair)
    assert one.directions is not None
    assert two.directions is not None
    found = []
    for T in planes.poses(a, b, (one.directions, two.directions), survey.motion(*pair)):
        if max(visibility.beyond(b, a, T), visibility.beyond(a, b, np.linalg.inv(T))) > HOPELESS:
            continue
        if rough_trust(visibility.compare(a, b, T, CLOSER)) > IN_VAIN and fresh(survey, pair, T):
            promise = PLANES * rough_trust(visibility.compare(a, b, T)) * looks.coincidence(one, two, T)
            if promise >= PROMISING:
                found.append(Look(promise, T))
    return found


def fresh(survey: Survey, pair: Ends, T_target_source: np.ndarray) -> bool:
    """Whether a pose is allowed, and no attempt at the pair has ended there."""
    moment, link = survey.moment(pair[0]), survey.links.get(pair)
    tried = [h.T_target_source for h in link.hypotheses] if link else []
    near = any(looks.displacement(T, T_target_source, moment) < claims.AGREE * survey.edges[pair[0]] for T in tried)
    return not near and survey.allowed(*pair, T_target_source)


def linked(survey: Survey, number: int) -> bool:
    """Whether ``align`` is sure of any link of a scan."""
    return any(number in ends and link.status == "aligned" for ends, link in survey.links.items())


def look_at(survey: Survey, pairs: list[Ends]) -> None:
    """Takes in the looks at some pairs."""
    with survey.stage("look"):
        survey.looks.update(zip(pairs, survey.each("looking", lambda p: look(survey, p), pairs), strict=True))
    with survey.stage("see through"):
        promising = [p for p in pairs if survey.looks[p].promise >= PROMISING]
        survey.each("finding viewpoints", survey.viewed, sorted({n for p in promising for n in p}))
        discount_contradicted(survey, promising)


def look(survey: Survey, pair: Ends) -> Look:
    """What the local features of two scans say, without poses that are not allowed."""
    edge = max(survey.pair_edge(*pair), 1e-300)
    a, b = (survey.description(n, edge) for n in pair)
    found = looks.look(a, b, survey.motion(*pair, edge))
    return looks.best_of([x for x in every(found) if survey.allowed(*pair, x.T_target_source)])


def every(found: Look) -> list[Look]:
    """A look's poses, each as a look of its own."""
    return [replace(x, others=()) for x in (found, *found.others)]


def discount_contradicted(survey: Survey, pairs: list[Ends]) -> None:
    """Makes looks less promising where the scans' views contradict them; a look's pose is rough, and so is that.

    Nothing is changed where even each scan's best look is contradicted: such scans weren't taken from one place.
    """

    def views(pair: Ends) -> list[visibility.Seen]:
        return survey.seen((*pair, x.T_target_source) for x in every(survey.looks[pair]) if x.promise >= PROMISING)

    seen = dict(zip(pairs, survey.each("comparing views", views, pairs), strict=True))
    telling = visibility.from_one_place([(p, x) for p, found in seen.items() for x in found], ROUGHLY_ONE_PLACE)
    for pair, found in seen.items():
        if pair[0] in telling:
            factors = (rough_trust(x) for x in found)
            poses = zip(every(survey.looks[pair]), factors, strict=False)
            survey.looks[pair] = looks.best_of([replace(x, promise=f * x.promise) for x, f in poses])


def rough_trust(seen: Seen) -> float:
    """What views leave of the promise of a rough pose, from 0 to 1."""
    return float(np.exp(-((seen.contradiction / ROUGHLY) ** 2) / 2))


def untried(survey: Survey, start: str, least: float = PROMISING) -> list[Ends]:
    """Pairs of that promise which have not been registered from this kind of start, best first.

    A look gives up the poses that have been tried, and its promise with them; of other starts a pair has one.
    """
    pairs = [p for p, x in survey.looks.items() if x.promise >= least]
    pairs = [p for p in pairs if start == "look" or (*p, start) not in survey.tried]
    return sorted((p for p in pairs if p not in survey.never), key=lambda p: (-survey.looks[p].promise, p))


def alike_first(survey: Survey, pairs: Iterable[Ends]) -> list[Ends]:
    """Pairs, those first whose scans most resemble each other as places: where looks have failed, that still tells."""
    place = {n: k for k, n in enumerate(sorted(survey.edges))}
    return sorted(pairs, key=lambda p: (-survey.similarity[place[p[0]], place[p[1]]], p))


def leading_out(survey: Survey, pairs: Iterable[Ends], most: int) -> list[Ends]:
    """Of pairs, best first, the first ``most`` of each component that join it to another one."""
    home = {n: k for k, c in enumerate(survey.components) for n in c.T_component_scan}
    taken: dict[int, int] = {}
    chosen = []
    for p in pairs:
        ends = {home[n] for n in p}
        if len(ends) == 2 and any(taken.get(k, 0) < most for k in ends):
            chosen.append(p)
            for k in ends:
                taken[k] = taken.get(k, 0) + 1
    return chosen
