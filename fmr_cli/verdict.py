"""Is the pose right? Evidence gathered at it, and the probability that it gives.

The evidence is dimensionless: distances count in voxel edges, feature errors against the features' own size. The
weights come from ``python -m benchmarks.calibrate``, fitted on procedural scenes that no test uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmr_cli.preprocess import Surface

ALIGNED = 0.5  # confidence from which a pose is called aligned
TOUCHING = 1.5  # voxel edges


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    overlap: share of the smaller scan within TOUCHING of the other one. inlier_rmse: of those, own unit.
    normals: mean |cosine| between the normals of touching points.
    votes: how many matches of local features agree with the pose, whether or not it came from them.
    votes_over_rival, fit_over_rival: the votes (plus one) and the share of the source that coincides with the target,
        each over the most that another pose has, which matches agree on but which was rejected.
    contrast: the global feature's error at a pose as good as random, over that at this one.
    """

    overlap: float
    inlier_rmse: float
    normals: float
    votes: int
    votes_over_rival: float
    fit_over_rival: float
    contrast: float

    def vector(self) -> np.ndarray:
        """What the logistic model sees, after a 1 for the intercept: of each kind of evidence, more is better."""
        ratios = [self.overlap, self.votes_over_rival, self.fit_over_rival, self.contrast]
        return np.array([1.0, self.normals, np.log1p(self.votes), *np.log(np.clip(ratios, 1e-2, 1e2))])


def fit(source: Surface, target: Surface, T: np.ndarray) -> dict[str, float]:
    """How the surfaces fit at T (4x4, source to target, in their frames), both on the same voxel edge.

    Returns the ``Evidence`` that geometry gives: overlap, inlier_rmse, normals.
    """
    reach = TOUCHING * target.edge
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    back = (target.points - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T
    forth_d, forth_i = target.tree.query(moved, distance_upper_bound=reach)
    back_d = source.tree.query(back, distance_upper_bound=reach)[0]
    here, touching = np.isfinite(forth_d), np.concatenate([forth_d, back_d])
    touching = touching[np.isfinite(touching)]
    cosine = np.einsum("ni,ni->n", source.normals[here] @ T[:3, :3].T, target.normals[forth_i[here]])
    return {
        "overlap": float(max(here.mean(), np.isfinite(back_d).mean())),
        "inlier_rmse": float(np.sqrt(np.mean(touching**2))) if len(touching) else float("inf"),
        "normals": float(np.abs(cosine).mean()) if here.any() else 0.0,
    }


# `python -m benchmarks.calibrate --pairs 130 --seed 41000`
WEIGHTS = np.array([-5.613, 3.203, 0.558, 1.469, 1.699, 1.892, 1.175])


def confidence(evidence: Evidence) -> float:
    """The probability that the pose is right: logistic regression on the evidence."""
    return float(1 / (1 + np.exp(-np.clip(WEIGHTS @ evidence.vector(), -50, 50))))
