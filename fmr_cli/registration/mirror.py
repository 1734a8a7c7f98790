"""Left-handed files: the mirror image of a cloud, and what is found of it as a transform of the cloud itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.registration.confidence import ALIGNED, Candidate, among
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Registration

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])  # any plane would do: what is found of the image has any rotation
HINT = (
    "the mirror image of the source fits (confidence {:.2f}): one of the files is mirrored or left-handed, as where an "
    "axis is swapped or points the other way; mend it, or let --allow-mirror find a transform that mirrors"
)
BETTER = "the mirror image of the source fits better: {:.0%} of the smaller scan lies on the other one, not {:.0%}"
# From so much of what both scans saw there that contradicts a pose, if it explains less than half of the smaller scan,
# the mirror image is asked: a mirrored room fits where a wall and a corner do, by 17 to 30 %, 2 to 12 % against.
HARDLY, HALF = 0.01, 0.5


def image(cloud: PointCloud | Prepared, seed: int) -> Prepared:
    """The cloud mirrored in the file's plane x = 0."""
    points = cloud.frame.leave(cloud.points) if isinstance(cloud, Prepared) else cloud.points
    mirrored = Prepared(PointCloud(points * MIRROR.diagonal()[:3]), seed)
    mirrored.read = cloud.read if isinstance(cloud, Prepared) else cloud.count
    mirrored.name, mirrored.crs = cloud.name, cloud.crs
    return mirrored


def unlikely(found: Registration) -> bool:
    """Whether so little contradicts a pose, or it explains so much, that its mirror image need not be asked."""
    against, explained = found.evidence["contradicted"], found.evidence["explained"]
    return bool(against <= HARDLY * (explained + against) or found.evidence["explained_share"] > HALF)


def weighed(found: Registration, image: Candidate | None) -> Registration:
    """What is left of a pose beside the mirror image's, if there is one: where that explains more, it has its share."""
    share, other = found.evidence["explained_share"], image.evidence.explained_share if image else 0.0
    if image is None or other <= share:
        return found
    confidence = among(found.confidence, [image.confidence])
    aligned = confidence >= ALIGNED
    reasons = found.reasons if aligned else [BETTER.format(other, share), *found.reasons]
    return replace(found, confidence=confidence, status="aligned" if aligned else "uncertain", reasons=reasons)


def undone(found: Registration, centre: np.ndarray) -> Registration:
    """What was found of the image, of the cloud itself. centre: (3,) the image's, file's coordinates."""
    T = found.T_target_source @ MIRROR
    own = centre * MIRROR.diagonal()[:3]
    return replace(
        found,
        T_target_source=T,
        mirrored=True,
        shift=float(np.linalg.norm(transform_points(T, own[None])[0] - own)),
        alternatives=[
            {**other, "T_target_source": (np.array(other["T_target_source"]) @ MIRROR).tolist()}
            for other in found.alternatives
        ],
    )
