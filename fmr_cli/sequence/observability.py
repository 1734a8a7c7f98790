"""Which motions of a scan against the map are observed, and by how much noise alone can pretend that they are.

A smooth tunnel, a blank wall or open ground lets a scan slide: whatever pose an alignment then gives along that
direction is noise, most often "no motion", since a scanner's own pattern fits itself best where it was. Normals that
are a little wrong hide it: through them every direction has some information. Two kinds of error are told apart.

- Errors of a point's normal and of the map's beside it that are independent: the information of the one Jacobian times
  the other keeps what is real and averages these to nothing, as the reliability ratio of errors-in-variables does.
- Errors that both share, because the scanner's pattern on a curved surface or along an edge is the same in both: a
  direction has to stand out from what normals pretend that are wrong by a few degrees, and normals of neighbours that
  fit no plane count little.

Lengths are in voxels. Constants without a reference are set by hand on made-up tunnels, corridors, walls and streets;
the tests hold what they give there and on real drives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fmr_cli.geometry.point_to_plane import linearise, step_motion

# Of a direction's information, what must be real for it to count as observed: more than is not.
RELIABLE = 0.5
# Radians: what the normals of a scan and of the map are wrong by together. Where a scanner stands as it stood for a
# keyframe its pattern is the same in both, and so are the errors; once it has moved on they mostly are not.
WRONG, WRONG_STANDING = 0.05, 0.15
STANDING = 0.3  # voxels that the points have moved since a keyframe, on average: where a pattern holds a scan fast
LEAST_POINTS = 1.0  # that face a direction: what weighs less is chance
LEAST_SIGMA = 0.01  # voxels, of the distances between points and planes; no scanner's are smaller
# Share of the points that would have to face the weakest direction for it to be beyond doubt: it is not looked at more
# closely, which takes longer than the alignment. So many times WRONG² (at WRONG 0.02, at WRONG_STANDING 0.07).
CLEAR, CLEAR_TIMES = 0.02, 3.0


@dataclass(frozen=True)
class Matches:
    """Points of a scan on planes of the map, at the pose that they were fitted to.

    index: (N,), which points. moved: (N, 3), they, map axes. scan_normals, map_normals: (N, 3), unit, map axes, as each
    side sees the surface there. weight: (N,), robust, whatever their range. rms: of the distances between points and
    planes, which are ``distance`` (N,), along the map's normals.
    """

    index: np.ndarray
    moved: np.ndarray
    scan_normals: np.ndarray
    map_normals: np.ndarray
    weight: np.ndarray
    rms: float
    distance: np.ndarray

    @cached_property
    def pivot(self) -> np.ndarray:
        """(3,): their middle, so that no arm is much longer than it need be."""
        return self.moved.mean(0)

    @cached_property
    def jacobians(self) -> tuple[np.ndarray, np.ndarray]:
        """(6, N) each, about the pivot: what each point says about a motion, by the map's normal and by its own."""
        by_map, by_scan = (
            linearise(self.moved, self.moved, n, self.pivot)[1] for n in (self.map_normals, self.scan_normals)
        )
        return by_map, by_scan


@dataclass(frozen=True)
class Observability:
    """Six directions of motion and what is known along each.

    The motion of a twist (omega, v), map axes: x -> x + omega × (x - centre) + v. centre: (3,), of the points; radius:
    their root mean square distance from it, which turns radians into displacement.
    directions: (6, 6), a twist a column, independent of each other in the data. reliability: (6,), the share of each
    one's information that is real, 0 where hardly any point contributes. information: (6, 6) of a twist, rad⁻² and
    voxel⁻², of the observed directions together. hint: the least reliability where normals are believed as far as their
    neighbours bear them out: enough for a pose that something else speaks for as well.
    """

    centre: np.ndarray
    radius: float
    directions: np.ndarray
    reliability: np.ndarray
    information: np.ndarray
    hint: float = 1.0

    @property
    def observed(self) -> np.ndarray:
        """(6,), True where a direction is observed."""
        return self.reliability >= RELIABLE

    def as_observed(self) -> Observability:
        """The same where something else has shown that all directions are observed."""
        return replace(self, reliability=np.maximum(self.reliability, RELIABLE))

    def aside(self, T_map_scan: np.ndarray, distance: float) -> list[np.ndarray]:
        """Poses (4, 4) that move the points by ``distance`` (RMS) along each unobserved direction, to either side."""
        steps = self.directions[:, ~self.observed]
        steps = steps * distance / np.sqrt(self.radius**2 * (steps[:3] ** 2).sum(0) + (steps[3:] ** 2).sum(0))
        return [step_motion(side * step, self.centre) @ T_map_scan for step in steps.T for side in (1, -1)]

    @property
    def unobserved(self) -> list[str]:
        """The other directions, in words."""
        return in_words(self.directions[:, ~self.observed], self.radius)


@dataclass(frozen=True)
class Weighed:
    """What weighted matches say about a motion about their centre, rotations as displacements at ``radius``.

    centre, radius: as in ``Observability``. about: (6, 6), a Jacobian of ``Matches`` as one about the centre. by_map:
    (6, 6), information by the map's normals alone, with all that is wrong with them; by_both: by the one Jacobian times
    the other, what is real of it.
    """

    centre: np.ndarray
    radius: float
    about: np.ndarray
    by_map: np.ndarray
    by_both: np.ndarray

    @classmethod
    def of(cls, matches: Matches, weight: np.ndarray) -> Weighed:
        """weight: (N,)."""
        arm = matches.moved - matches.pivot
        offset = weight @ arm / weight.sum()
        radius = float(np.sqrt(weight @ ((arm - offset) ** 2).sum(1) / weight.sum()))
        about = np.eye(6)
        about[:3, 3:] = np.cross(offset, np.eye(3))
        about[:3] /= radius
        by_map, by_scan = matches.jacobians
        weighed = by_map * weight
        H, cross = (about @ (weighed @ J.T) @ about.T for J in (by_map, by_scan))
        return cls(matches.pivot + offset, radius, about, H, (cross + cross.T) / 2)

    def observability(self, pretended: np.ndarray | float, rms: float) -> Observability:
        """The directions v with by_both v = reliability (by_map + pretended) v, mixed in neither of the two."""
        H = self.by_map + 1e-9 * np.trace(self.by_map) * np.eye(6) + pretended
        root = np.linalg.cholesky(H)
        whitened = np.linalg.solve(root, np.linalg.solve(root, self.by_both).T)
        reliability, vectors = np.linalg.eigh((whitened + whitened.T) / 2)
        directions = np.linalg.solve(root.T, vectors)
        facing = reliability / np.linalg.norm(directions, axis=0) ** 2  # so many points would weigh as much
        reliability = np.where(facing >= LEAST_POINTS, reliability, 0.0)
        known = np.where(reliability >= RELIABLE, reliability, 0.0) / max(rms, LEAST_SIGMA) ** 2
        inverse = np.linalg.inv(directions)
        scale = np.array([self.radius] * 3 + [1.0] * 3)
        information = np.outer(scale, scale) * (inverse.T @ (known[:, None] * inverse))
        return Observability(self.centre, self.radius, directions / scale[:, None], reliability, information)


def clearly_observed(matches: Matches, wrong: float) -> Observability | None:
    """What matched points say about the pose they are at, where no direction is weak; else None.

    wrong: radians that the normals of both sides are wrong by together.
    """
    weighed = Weighed.of(matches, matches.weight)
    if np.linalg.eigvalsh(weighed.by_both)[0] < max(CLEAR, CLEAR_TIMES * wrong**2) * matches.weight.sum():
        return None
    return weighed.observability(0.0, matches.rms).as_observed()


def observe(matches: Matches, trust: np.ndarray, wrong: np.ndarray | float) -> Observability:
    """The same, however weak; trust: (N,), 0 to 1, in their normals; wrong: (N,), rad, what these are wrong by."""
    weighed = Weighed.of(matches, matches.weight * trust)
    pretended = across(matches, matches.weight * trust * wrong**2, weighed)
    return weighed.observability(pretended, matches.rms)


def across(matches: Matches, weight: np.ndarray, weighed: Weighed) -> np.ndarray:
    """(6, 6): the information that normals pretend which are wrong by 1 in every direction across them.

    weight: (N,). With arm, the points about the centre over the radius, and the Jacobian (arm × e, e) of an error e,
    this is Σ w (G Gᵀ - g gᵀ), G = [hat(arm); I], g = (arm × n, n).
    """
    arm = (matches.moved - weighed.centre) / weighed.radius
    moment, second = weight @ arm, (arm * weight[:, None]).T @ arm
    all_sides = np.zeros((6, 6))
    all_sides[:3, :3] = np.trace(second) * np.eye(3) - second
    all_sides[3:, 3:] = weight.sum() * np.eye(3)
    all_sides[:3, 3:] = np.cross(moment, np.eye(3)).T
    all_sides[3:, :3] = all_sides[:3, 3:].T
    by_map = matches.jacobians[0]
    return all_sides - weighed.about @ ((by_map * weight) @ by_map.T) @ weighed.about.T


def in_words(twists: np.ndarray, radius: float) -> list[str]:
    """The span of twists (6, k) as shifts and rotations, those first that are pure shifts; axes of the map."""
    if twists.shape[1] == 0:
        return []
    scale = np.array([radius] * 3 + [1.0] * 3)[:, None]
    span = np.linalg.qr(twists * scale)[0]  # displacements
    _, turning, mix = np.linalg.svd(span[:3], full_matrices=True)
    turning = np.concatenate([turning, np.zeros(len(mix) - len(turning))])
    said = []
    for share, vector in sorted(zip(turning, (span @ mix.T).T, strict=True), key=lambda item: item[0]):
        kind, axis = ("shift along", vector[3:]) if share < np.sqrt(0.5) else ("rotation about", vector[:3])
        axis = axis / np.linalg.norm(axis)
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        said.append("{} ({:.2f}, {:.2f}, {:.2f})".format(kind, *(np.round(axis, 2) + 0.0)))  # + 0.0: no -0.00
    return said
