"""A cloud made ready for registration, once for all pairs it takes part in."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.descriptors.patch_encoder import CHUNK, NEIGHBOURS, PATCH_RADIUS, LocalEncoder, describe_patches
from fmr_cli.errors import RegistrationError
from fmr_cli.geometry.frames import Frame
from fmr_cli.geometry.gicp import GicpCloud
from fmr_cli.geometry.planar import plane_of, raised
from fmr_cli.geometry.sampling import distinct, reach, sample, thinned, working_scale
from fmr_cli.geometry.smoothing import Roughness, roughness
from fmr_cli.geometry.strays import Strays, strays
from fmr_cli.geometry.surface import MIRRORED, Surface
from fmr_cli.geometry.voxels import Voxels, voxel_downsample
from fmr_cli.io.crs import code_of, in_degrees, name_of, same
from fmr_cli.registration.memo import Memo

MIN_POINTS = 10  # fewer say nothing about a surface
AT_MOST = 1_000_000  # points of a cloud that are looked at: a hundred and more in every voxel
SPACINGS = 2.0  # a voxel edge spans, at least, so that a surface fills its voxels
LARGEST_RATIO = 3.0  # of the two clouds' own voxel edges
AT_A_TIME = 1000  # patches of a map: 100 MB
LARGE = 200_000  # points: sorting them into voxels takes longer than all else that is known of their grid
KEPT = 6  # results of each kind that a cloud keeps: the grids and features of one pair, for its next pair


@dataclass(frozen=True)
class Described:
    """The first ``asked`` keypoints of a surface, or fewer where it has fewer: (K, 3), and their descriptors (K, d)."""

    asked: int
    keypoints: np.ndarray
    descriptors: np.ndarray


class Prepared:
    """A cloud made ready for registration; what is computed from it is kept, within bounds, for its next pair.

    points: (N, 3) float64, centred, at most AT_MOST, finite and distinct. frame: the centred coordinates, whose origin
    is the mean of the cloud. edge: the voxel edge that suits this cloud; spacing: of its points; reach: of most of them
    from their middle; file's unit. notes: what a person should know of it, as how many points are no surface (see
    ``strays``). Raises RegistrationError: fewer than 10 distinct points, all in one place.
    """

    def __init__(self, cloud: PointCloud, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        # A column's values one after the other: what follows goes column by column, in two thirds of the time
        points = np.asfortranarray(thinned(cloud.points, AT_MOST, rng))
        if not np.isfinite(points.sum()):  # cheap, and hardly any cloud has others
            points = points[np.isfinite(points).all(1)]
        found = strays(points, np.random.default_rng(seed)) if len(points) else Strays(np.ones(0, bool), {})
        points = points if found.keep.all() else points[found.keep]
        self.notes = [f"{cloud.name}: {note}" for note in cloud.notes]
        self.notes += [
            f"{cloud.name}: {n} {f'points {why} are' if n > 1 else f'point {why} is'} no surface, set aside"
            for why, n in found.reasons.items()
            if n
        ]
        self.frame = Frame(np.array([c.mean() for c in points.T]) if len(points) else np.zeros(3))
        points = distinct(self.frame.enter(points))
        if len(points) == 1 and len(cloud) > 1:
            raise RegistrationError(f"{cloud.name}: all {len(cloud)} points are in one place; give a scan of a surface")
        if len(points) < MIN_POINTS:
            raise RegistrationError(
                f"{cloud.name}: {len(points)} distinct points, registration needs {MIN_POINTS}; give a denser scan"
            )
        self.name, self.read, self.seed, self.crs = cloud.name, cloud.count, seed, cloud.crs
        self.sensor_origin = cloud.sensor_origin
        if cloud.crs and in_degrees(cloud.crs, cloud.points.min(0), cloud.points.max(0)):
            raise RegistrationError(
                f"{cloud.name}: is in degrees ({name_of(cloud.crs)}), which are no lengths: project it first, "
                "by `fmr transform FILE --crs EPSG:... -o OUT` say"
            )
        self.plane = plane_of(points)
        self._hold(points if self.plane is None else raised(points, self.plane, rng), rng)

    def _hold(self, points: np.ndarray, rng: np.random.Generator) -> None:
        """Points (N, 3), centred, and their scales; nothing is known of them yet."""
        self.points = points
        self.edge, self.spacing = working_scale(points, rng)
        self.reach = reach(points, np.random.default_rng(self.seed))
        self._seen_in_mirror: Prepared | None = None  # whose voxels these are, if it is an image
        self._forget()

    def _forget(self) -> None:
        """What is computed from the points, for each kind of it: nothing yet."""
        self._surfaces, self._described, self._fine, self._gicp, self._roughness = (Memo(KEPT) for _ in range(5))
        self._grids = Memo(KEPT)
        self.on_sites = Memo(KEPT)  # what is found of it there, by site

    @property
    def centre(self) -> np.ndarray:
        """(3,) where the centred coordinates have their origin, file's coordinates."""
        return self.frame.origin

    @property
    def eye(self) -> np.ndarray | None:
        """(3,) where the sensor was, centred coordinates; None where the file doesn't state it."""
        return None if self.sensor_origin is None else self.frame.enter(self.sensor_origin[None])[0]

    def part(self, inside: np.ndarray) -> Prepared:
        """The points ``inside`` (N,) alone, in a centred frame of their own; what is said of the cloud stays."""
        part = copy(self)
        points = self.points[inside]
        part.frame = Frame(self.frame.origin + points.mean(0))
        part._hold(points - points.mean(0), np.random.default_rng(self.seed))
        return part

    def scaled(self, factor: float) -> Prepared:
        """The same cloud with every length multiplied by ``factor``."""
        origin = None if self.sensor_origin is None else self.sensor_origin * factor
        return Prepared(PointCloud(self.frame.leave(self.points) * factor, sensor_origin=origin), self.seed)

    def mirrored(self) -> Prepared:
        """The same cloud in the mirror x = 0 of the file's coordinates, on the same voxels."""
        image = copy(self)
        image.frame = Frame(self.frame.origin * MIRRORED)
        image.points = self.points * MIRRORED
        image.plane = None if self.plane is None else self.plane * MIRRORED
        image.sensor_origin = None if self.sensor_origin is None else self.sensor_origin * MIRRORED
        image._forget()
        image._seen_in_mirror = self
        return image

    def surface(self, edge: float) -> Surface:
        """The centred cloud on a voxel grid of ``edge``."""

        def make() -> Surface:
            own = self._seen_in_mirror
            return own.surface(edge).mirrored() if own else Surface(self.thinned(edge, 2), edge, thinned=True)

        return self._surfaces.get(edge, make)

    def thinned(self, edge: float, halvings: int = 0) -> np.ndarray:
        """The centred points' means in voxels of ``edge``: (M, 3).

        halvings: how many times half the edge will be asked for as well; of a large cloud, the finest grid is made
        first, and the others of it.
        """
        return self._voxels(edge, halvings).means if len(self.points) > LARGE else voxel_downsample(self.points, edge)

    def _voxels(self, edge: float, halvings: int) -> Voxels:
        def make() -> Voxels:
            return self._voxels(edge / 2, halvings - 1).doubled() if halvings else Voxels.of(self.points, edge)

        return self._grids.get(edge, make)

    def described(self, edge: float, count: int, encoder: LocalEncoder) -> tuple[np.ndarray, np.ndarray]:
        """At most ``count`` keypoints (K, 3), centred, and their descriptors (K, d).

        Of more than a look before asked for, only what is new is described.
        """

        def describe(begun: Described | None) -> Described:
            if begun and begun.asked >= count:
                return begun
            asked = -(-count // CHUNK) * CHUNK
            surface = self.surface(edge)
            index, parts = surface.keypoints(asked), [begun.descriptors] if begun else []
            new = index[sum(map(len, parts)) :]
            if len(new):
                parts.append(descriptors(surface, new, encoder))
            return Described(asked, surface.points[index], np.concatenate(parts))

        found = self._described.renew((edge, encoder.key), describe)
        return found.keypoints[:count], found.descriptors[:count]

    def described_evenly(
        self, edge: float, count: int, block: float, encoder: LocalEncoder, threads: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """``described`` with at most ``count`` keypoints in each block of that edge: all of a map, piece by piece."""

        def describe() -> tuple[np.ndarray, np.ndarray]:
            surface = self.surface(edge)
            index = surface.keypoints(count, block)
            _ = surface.normals  # before the threads ask for them

            pieces = (index[first : first + AT_A_TIME] for first in range(0, len(index), AT_A_TIME))
            with ThreadPoolExecutor(threads) as pool:
                found = list(pool.map(lambda piece: descriptors(surface, piece, encoder), pieces))
            return surface.points[index], np.concatenate(found)

        return self._described.get((edge, count, block, encoder.key), describe)

    def fine(self, count: int, edge: float) -> np.ndarray:
        """At most ``count`` points for the polish: the cloud's own where it is not too large, else on a fine grid."""

        def thin() -> np.ndarray:
            points = self.points if len(self.points) <= 4 * count else self.thinned(edge / 2)
            return sample(points, count, np.random.default_rng(self.seed))

        return self._fine.get((count, edge), thin)

    def roughness(self, count: int, edge: float, wide: int) -> Roughness:
        """Of ``fine``."""
        return self._roughness.get((count, edge), lambda: roughness(self.fine(count, edge), wide))

    def for_gicp(self, count: int, edge: float, threads: int) -> GicpCloud:
        """``fine`` as small_gicp takes it."""
        return self._gicp.get((count, edge), lambda: GicpCloud(self.fine(count, edge), edge, threads))


def descriptors(surface: Surface, index: np.ndarray, encoder: LocalEncoder) -> np.ndarray:
    """Of the patches about points ``index`` (K,): (K, d)."""
    return encoder(describe_patches(**surface.patches(index, PATCH_RADIUS, NEIGHBOURS)))


def check_systems(source: Prepared, target: Prepared) -> None:
    """Raises RegistrationError where the files state two coordinate reference systems."""
    a, b = source.crs, target.crs
    if a and b and same(a, b) is False:
        raise RegistrationError(
            f"{source.name} is in {name_of(a)} and {target.name} in {name_of(b)}: bring them into one system first, "
            f"by `fmr transform {source.name} --crs {code_of(b) or 'EPSG:...'} -o OUT` say"
        )


def pair_edge(source: Prepared, target: Prepared) -> float:
    """The voxel edge for both: the finer one's, but not below either's spacing, nor too fine for the larger one."""
    fine, coarse = sorted((source.edge, target.edge))
    return max(fine, coarse / LARGEST_RATIO, SPACINGS * source.spacing, SPACINGS * target.spacing)
