"""What a pair that was tried and not found says against a join of components at which its scans would overlap.

By Bayes' rule it lowers the odds by P(not found | the join is right) / P(not found | it is wrong). The latter is about
1; the former is how often pairs that do overlap are missed, which differs from one kind of scan to another. So it is
counted in the network: on pairs of which a third scan, linked surely to both, tells where they are. Sure links that no
other confirms tell nothing here: a wrong one makes all pairs beside it look as if they were missed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from fmr_cli.multiway.claims import AGREE, contradicted
from fmr_cli.multiway.links import Link
from fmr_cli.multiway.looks import displacement
from fmr_cli.multiway.parts import in_triangles

# From this overlap up to the next; pairs that count as seen beforehand, and those of them that were missed: of scans
# that register well one in twenty is missed at half overlap, one in three at a third; from its own pose, one in twenty.
BANDS = ((0.5, 10.0, 0.5), (0.3, 3.0, 1.0))
POSED = ((0.5, 10.0, 0.5), (0.3, 10.0, 0.5))
LIKELY = 0.5  # confidence of a hypothesis that is likelier right than wrong
NEARBY = 20.0  # voxel edges that a registration is taken to move from where it begins, at most

Weights = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Denials:
    """From which overlap on a pair that found nothing lowers the log odds of a join, and by how much.

    sought: where the pair had to be found; posed: where it was tried from the pose at which it would overlap, or near.
    """

    sought: Weights = ()
    posed: Weights = ()

    def of(self, link: Link, shared: float, T_target_source: np.ndarray, moment: np.ndarray) -> float:
        """What a link that found nothing says against a pose (4, 4) at which its scans share so much."""
        weights = self.posed if link.start == "pose" and begun_near(link, T_target_source, moment) else self.sought
        return next((x for least, x in weights if shared >= least), 0.0)


def denials(
    links: list[Link],
    moments: dict[int, np.ndarray],
    overlap: Callable[[int, int, np.ndarray], float],
    scans: set[int],
) -> Denials:
    """How often pairs that overlap are missed, as weights. moments (4, 4), overlap: as of ``consistency.joined``.

    scans: whose views tell.
    """
    sure: dict[int, dict[int, np.ndarray]] = defaultdict(dict)  # T_second_first
    for link in links:
        if link.status == "aligned" and not contradicted(link.hypotheses[0], link.source in scans):
            T_target_source = link.hypotheses[0].T_target_source
            sure[link.source][link.target] = T_target_source
            sure[link.target][link.source] = np.linalg.inv(T_target_source)
    told_by = in_triangles({i: sure[i].keys() for i in sure})

    def weights(some: Iterable[Link], bands: tuple[tuple[float, float, float], ...]) -> Weights:
        tried, missed = ({least: 0 for least, _, _ in bands} for _ in range(2))
        for link in some:
            i, j = link.ends
            told = [sure[k][j] @ sure[i][k] for k in sorted(told_by.get(i, set()) & told_by.get(j, set()))]
            shared = [overlap(i, j, T) for T in told]
            band = next((least for least, _, _ in bands if max(shared, default=0.0) >= least), None)
            if band is not None:
                tried[band] += 1
                missed[band] += not found(link, told[int(np.argmax(shared))], moments[i])
        return tuple((least, -float(np.log((missed[least] + m) / (tried[least] + n)))) for least, n, m in bands)

    tried = [x for x in links if x.status != "failed" and x.start != "known"]
    return Denials(
        weights((x for x in tried if x.start != "pose"), BANDS), weights((x for x in tried if x.start == "pose"), POSED)
    )


def begun_near(link: Link, T_target_source: np.ndarray, moment: np.ndarray) -> bool:
    """Whether a link that was tried from a pose began near the one given, by where it ended: it moves a little."""
    reach = NEARBY * link.edge
    return any(float(displacement(h.T_target_source, T_target_source, moment)) < reach for h in link.hypotheses)


def found(link: Link, T_target_source: np.ndarray, moment: np.ndarray) -> bool:
    """Whether a link has a pose that is likely, and is the one given."""
    reach = AGREE * 1.5 * link.edge
    likely = [h.T_target_source for h in link.hypotheses if h.confidence > LIKELY]
    return any(float(displacement(T, T_target_source, moment)) < reach for T in likely)
