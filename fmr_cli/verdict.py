"""Is the pose right? Evidence gathered at it, and the probability that it gives.

The evidence is dimensionless: distances count in voxel edges, feature errors against the features' own size. The
weights come from ``python -m benchmarks.calibrate``, fitted on procedural scenes that no test uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmr_cli.preprocess import Surface

ALIGNED = 0.5  # confidence from which a pose is called aligned
TOUCHING, NEAR, AROUND = 1.5, 0.8, 2.4  # voxel edges


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    overlap: share of the smaller scan within TOUCHING of the other one. inlier_rmse: of those, own unit.
    near: of the points within AROUND of the other scan, the share within NEAR: surfaces that coincide, not just cross.
    normals: mean |cosine| between the normals of touching points.
    patches: median patch residual at the pose over the patches' mean feature norm; 1 where none is co-occupied.
    votes: how many matches of local features agree with the pose, whether or not it came from them.
    """

    overlap: float
    inlier_rmse: float
    near: float
    normals: float
    patches: float
    votes: int

    def vector(self) -> np.ndarray:
        """What the logistic model sees."""
        logs = np.log(np.maximum([self.overlap, self.patches], 1e-3))
        return np.array([1.0, logs[0], self.near, self.normals, logs[1], np.log1p(self.votes)])


def gather(source: Surface, target: Surface, T: np.ndarray, patches: float, votes: int) -> Evidence:
    """Evidence at T (4x4, source to target, in the surfaces' frames); both surfaces on the same voxel edge."""
    edge = target.edge
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    back = (target.points - T[:3, 3]) @ T[:3, :3]
    forth_d, forth_i = target.tree.query(moved, distance_upper_bound=AROUND * edge)
    back_d = source.tree.query(back, distance_upper_bound=AROUND * edge)[0]
    touching = np.concatenate([forth_d, back_d])
    touching = touching[touching < TOUCHING * edge]
    overlap = max(np.mean(forth_d < TOUCHING * edge), np.mean(back_d < TOUCHING * edge))
    around = np.isfinite(forth_d).sum() + np.isfinite(back_d).sum()
    near = (forth_d < NEAR * edge).sum() + (back_d < NEAR * edge).sum()
    here = np.flatnonzero(forth_d < TOUCHING * edge)
    cosine = np.einsum("ni,ni->n", source.normals[here] @ T[:3, :3].T, target.normals[forth_i[here]])
    return Evidence(
        overlap=float(overlap),
        inlier_rmse=float(np.sqrt(np.mean(touching**2))) if len(touching) else float("inf"),
        near=float(near / max(around, 1)),
        normals=float(np.abs(cosine).mean()) if len(here) else 0.0,
        patches=patches if np.isfinite(patches) else 1.0,
        votes=votes,
    )


WEIGHTS = np.array([-11.649, 1.029, 0.0, 3.199, 0.0, 2.642])


def confidence(evidence: Evidence) -> float:
    """The probability that the pose is right: logistic regression on the evidence."""
    return float(1 / (1 + np.exp(-np.clip(WEIGHTS @ evidence.vector(), -50, 50))))
