"""A pair of scans with its true pose, and when an estimate of it is right."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.geometry.pose_error import pose_error


@dataclass(frozen=True)
class Loaded:
    """A pair in memory. source (N, 3), target (M, 3): float64, the files' own unit; T_target_source (4, 4): the truth.

    information: (6, 6) of the true correspondences, see ``information``, or None.
    """

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    information: np.ndarray | None = None


@dataclass(frozen=True)
class Pair:
    """scene: pairs of one scene are averaged together. source, target: what the tables call the scans.

    load: reads the pair; raises FmrError where a file is bad.
    """

    scene: str
    source: str
    target: str
    load: Callable[[], Loaded]


class Criterion(Protocol):
    """When an estimate is right. text: the definition, for the tables."""

    @property
    def text(self) -> str: ...

    def __call__(self, T_target_source: np.ndarray, pair: Loaded) -> bool: ...


@dataclass(frozen=True)
class Within:
    """Right: the rotation is less than so many degrees off, the shift less than a length, or a share of the source.

    shift, or share: of the diagonal of the source's bounding box. centred: the shift is that of the source's mean,
    which does not depend on where the origin lies; else, as the field has it, that of the translations.
    """

    degrees: float
    shift: float = np.inf
    share: float | None = None
    centred: bool = False

    @property
    def text(self) -> str:
        bound = f"{self.share:.0%} of the source's diagonal" if self.share else f"{self.shift:g}"
        return f"{self.degrees:g} deg, {bound}"

    def __call__(self, T_target_source: np.ndarray, pair: Loaded) -> bool:
        degrees, shift = errors(T_target_source, pair, self.centred)
        bound = self.shift if self.share is None else self.share * float(np.linalg.norm(np.ptp(pair.source, axis=0)))
        return degrees < self.degrees and shift < bound


@dataclass(frozen=True)
class CorrespondenceRmse:
    """Right: the root mean square distance of the true correspondences is at most ``limit`` (3DMatch: 0.2 m)."""

    limit: float

    @property
    def text(self) -> str:
        return f"RMSE of the true correspondences {self.limit:g}"

    def __call__(self, T_target_source: np.ndarray, pair: Loaded) -> bool:
        return correspondence_rmse(T_target_source, pair) <= self.limit


def errors(T_target_source: np.ndarray, pair: Loaded, centred: bool = False) -> tuple[float, float]:
    """RRE in degrees and RTE in the scans' unit: of the translations, or (centred) of where the source's mean lands."""
    if not np.isfinite(T_target_source).all():
        return 180.0, np.inf
    degrees, shift = pose_error(
        T_target_source, pair.T_target_source, pair.source.mean(0) if centred else (0.0, 0.0, 0.0)
    )
    return float(degrees), float(shift)


def correspondence_rmse(T_target_source: np.ndarray, pair: Loaded) -> float:
    """The root mean square distance of a pair's true correspondences under an estimate (Choi et al. 2015, Redwood).

    To first order in E = inv(truth) T: sqrt(e' I e / I_00) with e = (t, q) of E, q the vector part of its unit
    quaternion, I the pair's information, I_00 the number of correspondences.
    """
    if pair.information is None or not np.isfinite(T_target_source).all():
        return np.inf
    E = np.linalg.inv(pair.T_target_source) @ T_target_source
    x, y, z, w = Rotation.from_matrix(E[:3, :3]).as_quat()
    e = np.array([*E[:3, 3], *(np.array([x, y, z]) * (1.0 if w >= 0 else -1.0))])
    return float(np.sqrt(max(e @ pair.information @ e, 0.0) / pair.information[0, 0]))


def information(points: np.ndarray) -> np.ndarray:
    """(6, 6) sum of G'G over points (n, 3) that have a correspondence, in the source's frame; as gt.info has it.

    G = [I | -2 [p]x]: how far p moves under a small motion (t, q), by t + 2 q x p.
    """
    cross = np.zeros((len(points), 3, 3))
    x, y, z = points.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross -= np.swapaxes(cross, 1, 2)
    G = np.concatenate([np.broadcast_to(np.eye(3), cross.shape), -2 * cross], axis=2)
    return np.einsum("nij,nik->jk", G, G)


@dataclass(frozen=True)
class DataSet:
    """Pairs and how they are judged.

    name: as in papers. right: when an estimate is. voxel: edge of the grid that baselines work on, in the scans' unit;
    None: a fiftieth of the target's extent. by_scene: recall and errors are means over scenes, as 3DMatch has it; else
    over pairs. notes: lines for a person.
    """

    name: str
    pairs: Sequence[Pair]
    right: Criterion
    voxel: float | None = None
    by_scene: bool = False
    centred: bool = False
    notes: list[str] = field(default_factory=list)

    def thinned(self, count: int | None) -> DataSet:
        """At most ``count`` pairs, spread evenly over all."""
        if count is None or count >= len(self.pairs):
            return self
        chosen = np.linspace(0, len(self.pairs) - 1, count).round().astype(int)
        return replace(self, pairs=[self.pairs[i] for i in chosen])
