"""What tells a pose from rivals that fit as well: one thing that it explains, and that poses of the like contradict.

In a facade of equal bays, a door lies on the other scan's door at the right pose. Shifted by a bay it lies before plain
wall, which contradicts that pose. But shifted so far that both doors lie beyond the other scan's end, all that both
scans show there fits as well as ever. What is left to say for the right pose is that the one thing which is unlike the
rest meets its like: by chance it hardly does.
"""

from __future__ import annotations

import numpy as np

from fmr_cli.registration.agreement import Way, both_ways, in_one_thing
from fmr_cli.registration.confidence import RIVAL_SUPPORT, Candidate, Judge
from fmr_cli.registration.pair import Pair

THING = 10  # points of both scans: fewer are what two views see differently of an edge
FAR_LARGER = 4.0  # times the largest thing that contradicts the best pose itself, that this one has at least
# A pose is one of the like, wrong by nothing but a thing, if it explains that share of what the best one explains, and
# of what contradicts it that share lies in the thing, which has no more points than that share of what it explains.
LIKE, ONE, SMALL = 0.3, 0.3, 0.1
CLOSE = 0.1  # of the best pose's weight, from which a rival must not explain the thing, too
TIMES = 2.0  # as many of its points that the best pose explains, at least, as a close rival does


def stands_out(judge: Judge) -> bool:
    """Whether the best pose explains a thing that one of the like contradicts, and that none of its close rivals does.

    Without close rivals it is not for these that it is doubted.
    """
    best, *others = judge.candidates
    close = [c for c in others if c.weight >= CLOSE * best.weight]
    if not close:
        return False
    things = [(c, thing(judge.pair, c)) for c in others if is_alike(c, best)]

    def explained(candidate: Candidate) -> int:
        """The most points of such a thing that a pose explains."""
        seen = explained_points(judge.pair, candidate)
        return max((int((seen & points).sum()) for c, points in things if c is not candidate), default=0)

    own = explained(best) if things else 0
    return own >= max(THING, FAR_LARGER * best.evidence.largest) and all(
        own >= TIMES * (explained(c) + 1) for c in close
    )


def is_alike(candidate: Candidate, best: Candidate) -> bool:
    """Whether a pose fits but for one thing."""
    e = candidate.evidence
    return (
        candidate.support >= RIVAL_SUPPORT
        and e.explained >= LIKE * best.evidence.explained
        and max(THING, ONE * e.contradicted) <= e.largest <= SMALL * e.explained
    )


def explained_points(pair: Pair, candidate: Candidate) -> np.ndarray:
    """Which of both surfaces' points, the source's first, the other one explains at a pose: (N + M,) bool."""
    ways = both_ways(pair.s, pair.t, candidate.T_target_source, 1)
    return np.concatenate([marked(way, way.explained) for way in ways])


def thing(pair: Pair, candidate: Candidate) -> np.ndarray:
    """Which of them are of the largest clusters that contradict it: (N + M,) bool."""
    found = []
    for way in both_ways(pair.s, pair.t, candidate.T_target_source, 1):
        part = way.contradicted.copy()
        part[part] = in_one_thing(way.points[part], pair.edge)
        found.append(marked(way, part))
    return np.concatenate(found)


def marked(way: Way, some: np.ndarray) -> np.ndarray:
    """Some of a way's points (n,), as a mask over all of the surface's."""
    mask = np.zeros(way.size, bool)
    mask[way.index[some]] = True
    return mask
