"""Which directions of a pose two scans determine, and how well."""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.point_to_plane import point_to_plane
from fmr_cli.geometry.surface import Surface

WEAK = 2e-3  # of the strongest direction's information: what the noise of the normals alone pretends to


def information(source: Surface, target: Surface, T: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The 6x6 information matrix of the pose, order (rotation, translation): rad⁻² and unit⁻².

    Of a twist in the target's frame about ``origin`` (3,), from point-to-plane at T; the residuals' own variance stands
    for the noise, and a voxel's points count as one observation.
    """
    normal = point_to_plane(
        source.points, target.points, target.normals, target.tree, T, 1.5 * target.edge, origin
    )  # fmt: skip
    floor = (1e-6 * target.edge) ** 2
    return normal.A[:6, :6] / max(normal.variance, floor)


def undetermined(info: np.ndarray, length: float) -> list[str]:
    """The directions that the scans hardly determine, in words: those WEAK against the strongest.

    info: (6, 6); length: turns radians into the unit, so that both kinds of motion compare.
    """
    S = np.diag([1 / length] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(S @ info @ S)
    said = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > WEAK * max(values[-1], 1e-300):
            continue
        omega, v = vector[:3], vector[3:]
        axis = omega if np.linalg.norm(omega) > np.linalg.norm(v) else v
        axis = axis / np.linalg.norm(axis)
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        where = "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))  # no -0.00
        said.append(f"rotation about {where}" if np.linalg.norm(omega) > np.linalg.norm(v) else f"shift along {where}")
    return said
