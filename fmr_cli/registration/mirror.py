"""Left-handed files: the mirror image of a cloud, and what is found of it as a transform of the cloud itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.surface import MIRRORED
from fmr_cli.registration.confidence import Candidate, among
from fmr_cli.registration.result import Registration

MIRROR = np.diag([*MIRRORED, 1.0])
HINT = (
    "the mirror image of the source fits (confidence {:.2f}): one of the files is mirrored or left-handed, as where an "
    "axis is swapped or points the other way; mend it, or let --allow-mirror find a transform that mirrors"
)
BETTER = "the mirror image of the source fits better: {:.0%} of the smaller scan lies on the other one, not {:.0%}"
# A pose that explains less than half of the smaller scan may be that of a mirrored room, which fits where a wall and a
# corner do, by 17 to 40 %: the mirror image is asked. It fits as a whole there, so that a first look finds it.
HALF = 0.5
EITHER = 0.5  # the most that is left of a pose where the mirror image, sure by itself, explains more of the scans


def unlikely(found: Registration) -> bool:
    """Whether a pose explains so much that its mirror image need not be asked."""
    return bool(found.evidence["explained_share"] > HALF)


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
    own = centre * MIRRORED
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
