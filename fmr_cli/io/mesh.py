"""Meshes: OFF, OBJ and STL (PLY with faces comes from ply.py); their surface is sampled, area by area."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.fields import Lines

FEWEST, MOST = 10_000, 1_000_000  # points sampled by default; in between, as many as the mesh has vertices


@dataclass
class Mesh:
    """Vertices (as a cloud with attributes, not yet checked for NaN) and the (M, 3) indices of its triangles."""

    vertices: PointCloud
    triangles: np.ndarray

    def sample(self, count: int | None, seed: int) -> PointCloud:
        """``count`` points spread evenly over the surface, the same for the same seed; 0 gives the vertices.

        Each point takes the attributes of its triangle's nearest corner.
        """
        cloud, corners = self.vertices, self.triangles
        size = (len(cloud), len(corners))
        if count == 0:
            return replace(cloud, mesh=size)
        if len(corners) and (corners.min() < 0 or corners.max() >= len(cloud)):
            raise CloudFileError(f"has a face that refers to a vertex it does not have ({len(cloud)} vertices)")
        finite = np.isfinite(cloud.points).all(1)
        corners = corners[finite[corners].all(1)]
        a, b, c = (cloud.points[corners[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        total = np.cumsum(area)
        if len(total) == 0 or not 0 < total[-1] < np.inf:
            raise CloudFileError("is a mesh without any surface to sample")
        if count is None:
            count = min(max(len(cloud), FEWEST), MOST)
        rng = np.random.default_rng(seed)
        face = np.minimum(np.searchsorted(total, rng.random(count) * total[-1], side="right"), len(corners) - 1)
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1 - u, u * (1 - v), u * v], 1)
        points = np.einsum("nk,nkd->nd", weights, cloud.points[corners[face]])
        nearest = corners[face, weights.argmax(1)]
        sampled = {name: values[nearest] for name, values in cloud.attributes.items()}
        dropped = int(len(finite) - finite.sum())
        return replace(cloud, points=points, attributes=sampled, dropped=dropped, mesh=size)


def read(path: Path, attributes: bool) -> PointCloud | Mesh:
    """OFF, OBJ or STL by the suffix. An OBJ without faces is a point cloud. ``attributes``: meshes here have none."""
    suffix = path.suffix.lower()
    if suffix == ".stl" and (mesh := read_binary_stl(path)):
        return mesh
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = Lines(file)
        vertices, faces = {".off": read_off, ".obj": read_obj, ".stl": read_text_stl}[suffix](lines)
    cloud = PointCloud(np.array(vertices, dtype=np.float64).reshape(-1, 3))
    return Mesh(cloud, fan(faces)) if faces else cloud


Parsed = tuple[list[list[float]], list[list[int]]]


def read_off(lines: Lines) -> Parsed:
    """OFF: numbers of vertices and faces, then one of them a line. ModelNet has files with `OFF490 518 0`."""
    rows = words_of(lines)
    head = next(rows, [""])
    match = re.fullmatch(r"(?:ST)?C?N?OFF(\d*)", head[0], re.ASCII)
    if not match:
        raise CloudFileError("is not an OFF file (its first line is not 'OFF')")
    counts = [word for word in (match[1], *head[1:]) if word] or next(rows, [])
    if len(counts) < 2 or not all(c.isascii() and c.isdigit() for c in counts[:2]):
        raise CloudFileError(f"line {lines.number}: expected the numbers of vertices and faces")
    promised = int(counts[0]), int(counts[1])
    vertices = [numbers(lines, row[:3], 3) for row in islice(rows, promised[0])]
    faces = []
    for first, *rest in islice(rows, promised[1]):
        corners = int(numbers(lines, [first], 1)[0])
        faces.append([int(n) for n in numbers(lines, rest[: max(corners, 0)], corners)])
    if (len(vertices), len(faces)) != promised:
        raise CloudFileError(
            f"promises {promised[0]} vertices and {promised[1]} faces, holds {len(vertices)} and {len(faces)}, "
            "it is truncated: copy it again"
        )
    return vertices, faces


def read_obj(lines: Lines) -> Parsed:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for kind, *rest in words_of(lines):
        if kind == "v":
            vertices.append(numbers(lines, rest[:3], 3))
        elif kind == "f":
            corners = [int(n) for n in numbers(lines, [word.split("/")[0] for word in rest], len(rest))]
            faces.append([n - 1 if n > 0 else len(vertices) + n for n in corners])
    return vertices, faces


def read_text_stl(lines: Lines) -> Parsed:
    vertices = [numbers(lines, words[1:4], 3) for words in words_of(lines) if words[0] == "vertex"]
    if not vertices or len(vertices) % 3 or not lines.last.strip().startswith("endsolid"):
        raise CloudFileError("is not a complete STL file, it is truncated or damaged: copy it again")
    return vertices, np.arange(len(vertices)).reshape(-1, 3).tolist()


def read_binary_stl(path: Path) -> Mesh | None:
    """None where it is a text file. Binary files may begin with "solid" too, so the size decides."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
        count = int.from_bytes(head[80:], "little")
        if size < 84 + 50 * count or len(head) < 84:
            if head[:5] == b"solid":
                return None
            raise CloudFileError(
                f"promises {count} triangles and is too short for them, it is truncated: copy it again"
            )
        records = np.fromfile(
            file, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flag", "<u2")]), count
        )
    return Mesh(PointCloud(records["corners"].reshape(-1, 3)), np.arange(3 * count).reshape(-1, 3))


def words_of(lines: Lines) -> Iterator[list[str]]:
    """The words of each line; blank lines and # comments are skipped."""
    for line in lines:
        words = line.split("#")[0].split()
        if words:
            yield words


def numbers(lines: Lines, words: list[str], count: int) -> list[float]:
    try:
        if len(words) != count:
            raise ValueError
        return [float(word) for word in words]
    except ValueError:
        raise CloudFileError(
            f"line {lines.number}: expected {count} numbers, found {lines.last.strip()[:60]!r}"
        ) from None


def fan(faces: Sequence[Sequence[int]] | np.ndarray) -> np.ndarray:
    """(M, 3) triangles of polygons with any number of corners; those with fewer than three are left out."""
    if isinstance(faces, np.ndarray):
        groups = [faces.astype(np.int64)]
    else:
        lengths = np.fromiter(map(len, faces), np.int64, len(faces))
        groups = [
            np.array([faces[i] for i in np.flatnonzero(lengths == k).tolist()], np.int64) for k in np.unique(lengths)
        ]
    triangles = [g[:, [0, i, i + 1]] for g in groups if g.ndim == 2 for i in range(1, g.shape[1] - 1)]
    return np.concatenate(triangles) if triangles else np.empty((0, 3), np.int64)
