"""Left-handed files: the mirror image of a cloud, and what is found of it as a transform of the cloud itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.registration.confidence import Candidate, among
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Registration

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])  # any plane would do: what is found of the image has any rotation
HINT = (
    "the mirror image of the source fits (confidence {:.2f}): one of the files is mirrored or left-handed, as where an "
    "axis is swapped or points the other way; mend it, or let --allow-mirror find a transform that mirrors"
)
BETTER = "the mirror image of the source fits better: {:.0%} of the smaller scan lies on the other one, not {:.0%}"
# A pose that explains less than half of the smaller scan may be that of a mirrored room, which fits where a wall and a
# corner do, by 17 to 40 %: the mirror image is asked. Mostly 2 to 12 % contradict it there; where hardly anything
# does, a quick look has to be enough, since most of such poses are right.
HARDLY, HALF = 0.01, 0.5
EITHER = 0.5  # the most that is left of a pose where the mirror image, sure by itself, explains more of the scans


def image(cloud: PointCloud | Prepared, seed: int) -> Prepared:
    """The cloud mirrored in the file's plane x = 0."""
    points = cloud.frame.leave(cloud.points) if isinstance(cloud, Prepared) else cloud.points
    mirrored = Prepared(PointCloud(points * MIRROR.diagonal()[:3]), seed)
    mirrored.read = cloud.read if isinstance(cloud, Prepared) else cloud.count
    mirrored.name, mirrored.crs = cloud.name, cloud.crs
    return mirrored


def unlikely(found: Registration) -> bool:
    """Whether a pose explains so much that its mirror image need not be asked."""
    return bool(found.evidence["explained_share"] > HALF)


def contradicted(found: Registration) -> bool:
    """Whether more than hardly anything contradicts a pose."""
    against, explained = found.evidence["contradicted"], found.evidence["explained"]
    return bool(against > HARDLY * (explained + against))


def weighed(found: Registration, image: Candidate | None) -> Registration:
    """What is left of a pose beside the mirror image's, if there is one: where that explains more, no verdict."""
    share, other = found.evidence["explained_share"], image.evidence.explained_share if image else 0.0
    if image is None or other <= share:
        return found
    confidence = min(among(found.confidence, [image.confidence]), EITHER)
    reasons = [BETTER.format(other, share), *found.reasons]
    return replace(found, confidence=confidence, status="uncertain", reasons=reasons)


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
