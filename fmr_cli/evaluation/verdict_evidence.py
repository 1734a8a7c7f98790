"""The evidence at right and wrong poses of made-up scans: what the verdict's weights are fitted on.

Every pose that ``align`` would judge counts, so that the wrong ones are the plausible ones.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.cores import usable_cores
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.pose_error import pose_error
from fmr_cli.registration.confidence import Judge
from fmr_cli.registration.hypotheses import from_search
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import make_pair
from fmr_cli.registration.pipeline import FIRST, FURTHER, consider, features
from fmr_cli.registration.prepared import Prepared, pair_edge
from fmr_cli.registration.result import Stopwatch
from fmr_cli.synthetic.calibration_pairs import calibration_pair

Look = Literal["coarse", "features", "search"]

RIGHT_DEGREES = 5.0  # a pose that is less off is right, the field's usual bound (3DMatch takes 15), and within
RIGHT_EDGES = 2.0  # voxel edges: twice the resolution at which poses are compared
# What align has looked at when it ends: coarse voxels, local features, or the search as well. Pairs take turns.
LOOKS: tuple[Look, ...] = ("coarse", "features", "search")
CHUNK = 4  # pairs handed to a worker at a time: a pair takes a second, a hand-over a millisecond


@dataclass(frozen=True)
class EvidenceTable:
    """Of n poses. x: (n, k), ``confidence.Evidence.vector``; right: (n,) bool; pair: (n,) the pair each is of."""

    x: np.ndarray
    right: np.ndarray
    pair: np.ndarray

    def of(self, rows: np.ndarray) -> EvidenceTable:
        """Some of the poses, by a mask or indices (m,)."""
        return EvidenceTable(self.x[rows], self.right[rows], self.pair[rows])

    def save(self, path: Path) -> None:
        """As .npz, from which ``load`` makes the same again."""
        np.savez(path, x=self.x, y=self.right, pair=self.pair)

    @classmethod
    def load(cls, path: Path) -> EvidenceTable:
        data = np.load(path)
        return cls(data["x"], data["y"], data["pair"])


def gather(pairs: int, seed: int, workers: int | None = None) -> EvidenceTable:
    """The evidence at every candidate pose of ``pairs`` fresh pairs, the same whatever the number of workers."""
    with ProcessPoolExecutor(workers or usable_cores(), mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(pair_evidence, [(seed, number) for number in range(pairs)], chunksize=CHUNK))
    x, right, pair = zip(*((*pose, i) for i, poses in enumerate(found) for pose in poses), strict=True)
    return EvidenceTable(np.array(x), np.array(right), np.array(pair))


def pair_evidence(seed: tuple[int, int]) -> list[tuple[np.ndarray, bool]]:
    """The evidence at each candidate pose of the pair ``seed`` = (run, number), and whether the pose is right."""
    rng = np.random.default_rng(seed)
    source, target, together = calibration_pair(rng)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    source = transform_points(turn, source)
    try:
        candidates, edge = judged_candidates(source, target, LOOKS[seed[1] % len(LOOKS)], seed[1])
    except RegistrationError:  # a street and a teacup: nothing to judge
        return []
    truth, centre = np.linalg.inv(turn), source.mean(0)
    found = []
    for T, evidence in candidates:
        degrees, shift = pose_error(T, truth, centre)
        right = degrees < RIGHT_DEGREES and shift < RIGHT_EDGES * edge
        found.append((evidence, bool(together and right)))
    return found


def judged_candidates(
    source: np.ndarray, target: np.ndarray, look: Look, seed: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], float]:
    """(T_target_source, evidence vector) of every distinct pose that ``align`` would judge, and the pair's voxel edge.

    source (N, 3), target (M, 3). All that the calibration knows of the pipeline's inside is here. Raises
    RegistrationError where the clouds cannot be registered at all.
    """
    prepared = Prepared(PointCloud(source)), Prepared(PointCloud(target))
    pair = make_pair(*prepared, Options(seed=seed), 1, *(FIRST if look == "coarse" else FURTHER[0]))
    judge, time = Judge(pair), Stopwatch()
    consider(judge, features(pair, time), time)
    if look == "search":
        consider(judge, from_search(pair), time)
    candidates = [(pair.leave_centred(c.T_target_source), c.evidence.vector()) for c in judge.candidates]
    return candidates, pair_edge(*prepared)
