"""Made-up pairs on which a verdict is easily fooled or too shy, each with all poses that are right.

    pair = fresh_pair("facade, a door in both", seed, number)

The kinds, by family, are in ``FAMILIES``. A pair is ``unique`` where exactly one pose is right, so that a verdict
should say ``aligned``; where several fit equally well, or none is right, ``aligned`` is wrong whatever pose comes with
it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.synthetic import contradicting, ordinary, repeating, strays
from fmr_cli.synthetic.draft import Draft, Redraw, log_uniform
from fmr_cli.synthetic.sensors import Scan

FAMILIES = {
    "repetition": repeating.MAKERS,
    "contradiction": contradicting.MAKERS,
    "strays": strays.MAKERS,
    "degenerate": ordinary.DEGENERATE,
    "shy": ordinary.SHY,
    "ordinary": ordinary.EASY,
}
MAKERS = {kind: make for family in FAMILIES.values() for kind, make in family.items()}
KINDS = tuple(MAKERS)
NOISE = 0.0005, 0.01  # metres, of the points' coordinates, as made: the scenes are in metres
MOST_NOISE = 0.003  # of a scan's size: a detail of a few hundredths of it stays one
PROBES = 400  # points of the source by which a pose is judged
TRIES = 200


@dataclass(frozen=True)
class VerdictPair:
    """kind: one of KINDS. source (N, 3), target (M, 3): float64, in one unit, each in a frame of its own.

    poses: all T_target_source (4, 4) that are equally right. Of what maps onto itself at every shift (a plane, a
    tunnel), only the pose at which the scans were taken. Empty where no pose is right. unique: exactly one is.
    size: longest side of the target's bounding box, without points that are no surface. probes (K, 3): points of the
    source's surface. source_origin, target_origin (3,): where the sensor was, in each cloud's frame, if it was one.
    """

    kind: str
    source: np.ndarray
    target: np.ndarray
    poses: list[np.ndarray]
    unique: bool
    size: float
    probes: np.ndarray
    source_origin: np.ndarray | None = None
    target_origin: np.ndarray | None = None

    def of(self, poses: list[np.ndarray]) -> VerdictPair:
        """The same pair with these poses as the right ones."""
        return replace(self, poses=poses)

    def displacement(self, T_target_source: np.ndarray) -> float:
        """How far a pose moves the source's points from the nearest right pose, on the mean over ``size``."""
        found = transform_points(T_target_source, self.probes)
        away = [np.linalg.norm(found - transform_points(T, self.probes), axis=1).mean() for T in self.poses]
        return float(min(away, default=np.inf) / self.size)

    def is_right(self, T_target_source: np.ndarray, degrees: float = 180.0, share: float = 0.01) -> bool:
        """Whether the pose is within ``degrees`` and a mean displacement of ``share`` of the size of a right one."""
        turned = [angle_degrees(np.linalg.inv(T) @ T_target_source) for T in self.poses]
        return self.displacement(T_target_source) < share and min(turned) <= degrees


def make_pair(kind: str, rng: np.random.Generator) -> VerdictPair:
    """A fresh pair of one of KINDS; the same state of ``rng`` gives the same pair. Raises KeyError."""
    make = MAKERS[kind]
    for _ in range(TRIES):
        try:
            return moved(kind, make(rng), rng)
        except Redraw:
            continue
    raise RuntimeError(f"{kind}: no draw in {TRIES} kept what the kind promises")


def fresh_pair(kind: str, seed: int, number: int) -> VerdictPair:
    """Pair ``number`` of a kind in the series ``seed``: the same each time, unlike those of any other kind."""
    return make_pair(kind, np.random.default_rng((seed, number, *kind.encode())))


def moved(kind: str, draft: Draft, rng: np.random.Generator) -> VerdictPair:
    """The draft with noise, each scan in a frame of its own, in any unit."""
    size = draft.target.size
    share = MOST_NOISE if draft.noise is None else draft.noise
    sigma = min(log_uniform(rng, *NOISE), share * size) if draft.noise is None else draft.noise * size
    unit = 1.0 if rng.random() < 0.75 else log_uniform(rng, 1e-3, 1e3)
    by_sensor = len(draft.source.stray) + len(draft.target.stray) > 0 or rng.random() < 0.5
    clouds, frames = [], []
    for scan, turned in ((draft.source, True), (draft.target, rng.random() < 0.3)):
        turn, anchor = frame(scan, rng, turned, by_sensor, draft.flat)
        noise = rng.normal(0, sigma, scan.points.shape) * ([1, 1, 0] if draft.flat else 1)
        origin = np.empty((0, 3)) if scan.origin is None else scan.origin[None]
        # Off the anchor first, so that what lies at the sensor becomes exactly zero, as a sensor writes it.
        own = [unit * ((x - anchor) @ turn.T) for x in (scan.points + noise, scan.stray, origin)]
        clouds.append((own[0], own[1], own[2][0] if len(origin) else None))
        G = np.eye(4)
        G[:3, :3], G[:3, 3] = unit * turn, -unit * turn @ anchor
        frames.append(G)
    poses = [frames[1] @ T @ np.linalg.inv(frames[0]) for T in draft.aliases]
    (source, source_stray, source_origin), (target, target_stray, target_origin) = clouds
    return VerdictPair(
        kind, rng.permutation(np.concatenate([source, source_stray])),
        rng.permutation(np.concatenate([target, target_stray])), poses, draft.unique, size * unit,
        source[:: max(len(source) // PROBES, 1)], source_origin, target_origin,
    )  # fmt: skip


def frame(
    scan: Scan, rng: np.random.Generator, turned: bool, by_sensor: bool, flat: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The cloud's own frame: a rotation (3, 3), and the scene's point (3,) that becomes its origin.

    That is the sensor's place where ``by_sensor``, else any.
    """
    turn = Rotation.identity()
    if turned:
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)) if flat else Rotation.random(random_state=rng)
    if by_sensor and scan.origin is not None:
        return turn.as_matrix(), scan.origin
    return turn.as_matrix(), rng.normal(0, 2 * scan.size, 3) * ([1, 1, 0] if flat else 1)
