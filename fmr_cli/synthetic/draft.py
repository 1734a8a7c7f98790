"""A pair of scans before it is moved and made noisy, and what its makers have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.voxels import voxel_downsample
from fmr_cli.synthetic import sensors
from fmr_cli.synthetic.sensors import CELLS, DIFFERENT, Scan
from fmr_cli.synthetic.structures import Structure

SENSORS = ("surface", "terrestrial", "lidar", "camera")
ENOUGH = 12  # cells (1 / CELLS of a scan's size) that a detail covers in both scans, at least
CONTRADICTING = 24  # cells of both scans, at least, taken to where nothing is by a motion that is no alias
SPREAD = 0.025  # least share of the common surface's normals along any direction: a bare wall and a floor have none
LEAST = 40  # cells of the common surface
SHARED = 0.3  # of the source that an alias has to lay on the target to be worth listing


class Redraw(Exception):  # noqa: N818 - not an error: the draw has missed what its kind promises
    """Draw again: this draw does not keep what its kind promises."""


@dataclass
class Draft:
    """source, target: scans in one scene's frame, so that the identity is the right pose, if any is.

    aliases: all motions of the scene's frame that lay the source on the target equally well; empty if none does.
    flat: 2-D scans, which may only be turned in their plane. noise: standard deviation as a share of the size at most,
    None for the usual.
    """

    source: Scan
    target: Scan
    aliases: list[np.ndarray]
    unique: bool
    flat: bool = False
    noise: float | None = None


def once() -> list[np.ndarray]:
    """The aliases of a pair with one right pose."""
    return [np.eye(4)]


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def look(
    structure: Structure,
    sensor: str,
    rng: np.random.Generator,
    stand: np.ndarray,
    towards: np.ndarray,
    reach: float,
    density: float,
    facing: bool = True,
) -> Scan:
    """One scan of a structure by one of SENSORS from ``stand`` (3,), a camera looking along ``towards`` (3,).

    facing: whether an even scan shows only what faces the stand, or all there is.
    """
    scene = structure.scene
    if sensor == "surface":
        return sensors.surface_scan(scene, rng, density, stand if facing else None, structure.shells)
    if sensor == "terrestrial":
        return sensors.terrestrial_scan(scene, rng, stand, reach, int(rng.integers(160, 300)))
    if sensor == "lidar":
        return sensors.lidar_scan(scene, rng, stand, reach, int(rng.choice([32, 64])), int(rng.integers(360, 720)))
    return sensors.camera_scan(scene, rng, stand, towards, reach, int(rng.integers(4, 7)), wander=0.7)


def check_points(*scans: Scan, least: int = 800) -> None:
    """Raises Redraw where a scan has hardly seen the scene."""
    if min(len(scan.points) for scan in scans) < least:
        raise Redraw


def lands(structure: Structure, source: Scan, target: Scan) -> np.ndarray:
    """The share of the source that each of the structure's symmetries lays on the target."""
    size = min(source.size, target.size)
    cells = voxel_downsample(source.points, size / CELLS)
    probes = cells[:: max(len(cells) // 200, 1)]
    tree, near = cKDTree(target.points), 1.5 * size / CELLS
    moved = [transform_points(S, probes) for S in structure.symmetries]
    return np.array([np.isfinite(tree.query(x, distance_upper_bound=near)[0]).mean() for x in moved])


def aliases(structure: Structure, source: Scan, target: Scan) -> list[np.ndarray]:
    """The symmetries that lay enough of the source on the target and that no scan denies, the identity first."""
    shares = lands(structure, source, target)
    kept = [S for S, share in zip(structure.symmetries, shares, strict=True) if share >= min(SHARED, shares[0])]
    kept = [S for S in kept if denied(structure, source, target, S) < CONTRADICTING]
    return [S @ turn for S in kept for turn in structure.turns]


def denied(structure: Structure, source: Scan, target: Scan, S: np.ndarray) -> int:
    """How many cells of either scan a motion S of the scene's frame takes to where the other scan saw nothing.

    By the scene itself, without noise: into the other scan's view, off all solids by more than DIFFERENT, and not
    behind any. That one sensor saw sides which the other one could not see denies no motion: they stood otherwise then.
    """
    size, count = min(source.size, target.size), 0
    for one, other, T in ((source, target, S), (target, source, np.linalg.inv(S))):
        x = transform_points(T, voxel_downsample(one.points, size / CELLS))
        x = x[other.sees(x)]
        x = x[sensors.clearance(structure.scene, x, structure.shells) > DIFFERENT * size]
        if other.origin is not None and len(x):
            off = x - other.origin
            far = np.linalg.norm(off, axis=1)
            x = x[structure.scene.cast(other.origin, off / far[:, None]) > far]
        count += len(x)
    return count


def on_details(structure: Structure, points: np.ndarray) -> np.ndarray:
    """Which points (N, 3) belong to the details."""
    found = np.zeros(len(points), bool)
    for i in structure.details:
        found |= sensors.inside(structure.scene.maps[i], structure.scene.kinds[i], points, 0.02)
    return found


def check_unique(structure: Structure, source: Scan, target: Scan) -> None:
    """Raises Redraw unless the scans share details, and these contradict every alias.

    A detail contradicts a motion that takes it, within the other scan's view, to where that has no surface.
    """
    size = min(source.size, target.size)
    details = []
    for one, other in ((source, target), (target, source)):
        tree = cKDTree(other.points)
        cells = one.points[on_details(structure, one.points)]
        cells = voxel_downsample(cells, size / CELLS) if len(cells) else cells
        common = cells[tree.query(cells)[0] < 1.5 * size / CELLS] if len(cells) else cells
        if len(common) < ENOUGH:
            raise Redraw
        details.append((common[:: max(len(common) // 150, 1)], tree, other))
    for S, share in zip(structure.symmetries, lands(structure, source, target), strict=True):
        for turn in structure.turns[::20] if share >= SHARED else ():  # a body of revolution: every 60 deg
            T, against = S @ turn, 0
            for (cells, tree, other), way in zip(details, (T, np.linalg.inv(T)), strict=True):
                moved = transform_points(way, cells)
                against += int((other.sees(moved) & (tree.query(moved)[0] > DIFFERENT * size)).sum())
            if against < CONTRADICTING and not np.allclose(T, np.eye(4)):
                raise Redraw


def common_cells(source: Scan, target: Scan) -> np.ndarray:
    """The target's surface (K, 3), on a grid, that the source has too."""
    edge = min(source.size, target.size) / CELLS
    cells = voxel_downsample(target.points, edge)
    return cells[np.isfinite(cKDTree(source.points).query(cells, distance_upper_bound=1.5 * edge)[0])]


def check_tied(cells: np.ndarray) -> None:
    """Raises Redraw unless a common surface (K, 3) faces all ways, so that it ties the pose down."""
    if len(cells) < LEAST:
        raise Redraw
    around = cells[cKDTree(cells).query(cells, 8)[1]]
    around = around - around.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    if np.linalg.eigvalsh(normals.T @ normals / len(normals))[0] < SPREAD:
        raise Redraw


def several(structure: Structure, source: Scan, target: Scan) -> Draft:
    """A pair that fits in several ways. Raises Redraw where the scans share too little for a second one."""
    found = aliases(structure, source, target)
    if len(found) < 2:
        raise Redraw
    return Draft(source, target, found, unique=False)


def unique(structure: Structure, source: Scan, target: Scan) -> Draft:
    """A pair that fits in one way, because of the structure's details."""
    check_unique(structure, source, target)
    return Draft(source, target, once(), unique=True)


def swapped(pair: Sequence[Scan], rng: np.random.Generator) -> tuple[Scan, Scan]:
    """Either scan may be the source."""
    first, second = pair
    return (first, second) if rng.random() < 0.5 else (second, first)
