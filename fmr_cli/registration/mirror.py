"""Left-handed files: the mirror image of a cloud, and what is found of it as a transform of the cloud itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.result import Registration

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])  # any plane would do: what is found of the image has any rotation
HINT = (
    "the mirror image of the source fits (confidence {:.2f}): one of the files is mirrored or left-handed, as where an "
    "axis is swapped or points the other way; mend it, or let --allow-mirror find a transform that mirrors"
)


def image(cloud: PointCloud | Prepared, seed: int) -> Prepared:
    """The cloud mirrored in the file's plane x = 0."""
    points = cloud.frame.leave(cloud.points) if isinstance(cloud, Prepared) else cloud.points
    mirrored = Prepared(PointCloud(points * MIRROR.diagonal()[:3]), seed)
    mirrored.read = cloud.read if isinstance(cloud, Prepared) else cloud.count
    mirrored.name, mirrored.crs = cloud.name, cloud.crs
    return mirrored


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
