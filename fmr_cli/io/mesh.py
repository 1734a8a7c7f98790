"""Meshes: OFF, OBJ and STL (PLY with faces comes from ply.py); their surface is sampled, area by area."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.errors import CloudFileError
from fmr_cli.io.stream import COLORS, Wanted
from fmr_cli.io.table import Lines

FEWEST, MOST = 10_000, 1_000_000  # points sampled by default; in between, as many as the mesh has vertices


@dataclass
class Mesh:
    """Vertices, the (M, 3) indices of their triangles, and attributes of the triangles: name -> (M,).

    The vertices are a cloud with attributes, not yet checked for NaN.
    """

    vertices: PointCloud
    triangles: np.ndarray
    of_faces: dict[str, np.ndarray] = field(default_factory=dict)

    def sample(self, count: int | None, seed: int) -> PointCloud:
        """``count`` points spread evenly over the surface, the same for the same seed; 0 gives the vertices.

        Each point takes the attributes of its triangle's nearest corner.
        """
        cloud, corners = self.vertices, self.triangles
        size = (len(cloud), len(corners))
        if count == 0:
            lost = ("colours of the faces",) if self.of_faces else ()
            return replace(cloud, mesh=size, left_out=(*cloud.left_out, *lost))
        if len(corners) and (corners.min() < 0 or corners.max() >= len(cloud)):
            raise CloudFileError(f"has a face that refers to a vertex it does not have ({len(cloud)} vertices)")
        finite = np.isfinite(cloud.points).all(1)
        whole = finite[corners].all(1)
        corners = corners[whole]
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
        sampled |= {name: values[whole][face] for name, values in self.of_faces.items()}
        dropped = int(len(finite) - finite.sum())
        return replace(cloud, points=points, attributes=sampled, dropped=dropped, mesh=size)


def read(path: Path, wanted: Wanted) -> Iterator[PointCloud | Mesh]:
    """OFF, OBJ or STL by the suffix, with the colours of vertices or faces. An OBJ without faces is a point cloud."""
    suffix = path.suffix.lower()
    if suffix == ".stl" and (mesh := read_binary_stl(path)):
        yield mesh
        return
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = Lines(file)
        found = {".off": read_off, ".obj": read_obj, ".stl": read_text_stl}[suffix](lines)
    cloud = PointCloud(np.array(found.vertices, dtype=np.float64).reshape(-1, 3), left_out=found.left_out)
    colors = colors_of(found.colors, len(cloud), suffix)
    if wanted.attributes:
        cloud.attributes |= colors
    if not found.faces:
        yield cloud
        return
    of_faces = {} if colors or not wanted.attributes else colors_of(found.face_colors, len(found.faces), suffix)
    yield Mesh(cloud, *fan(found.faces, of_faces))


@dataclass
class Parsed:
    """What the lines of a mesh file say."""

    vertices: list[list[float]]
    faces: list[list[int]]
    colors: list[list[float]]  # three or four numbers for each vertex, or for each face; none where not for all
    face_colors: list[list[float]]
    left_out: tuple[str, ...] = ()


def colors_of(rows: list[list[float]], count: int, suffix: str) -> dict[str, np.ndarray]:
    """Columns red, green, blue and maybe alpha of colours from 0 to 255 or from 0 to 1, where all ``count`` have one.

    8 bits where they are integers; shares as they are.
    """
    if len(rows) != count or not rows or len({len(row) for row in rows}) != 1 or len(rows[0]) not in (3, 4):
        return {}
    values = np.array(rows)
    if (suffix != ".obj" and values.max() > 1) or (values.max() > 1 and (values == np.rint(values)).all()):
        values = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return dict(zip((*COLORS, "alpha"), values.T, strict=False))


def read_off(lines: Lines) -> Parsed:
    """OFF: numbers of vertices and faces, then one of them a line. ModelNet has files with `OFF490 518 0`.

    A vertex of COFF, or one that just has more numbers, ends in its colour; so does a face.
    """
    rows = words_of(lines)
    head = next(rows, [""])
    match = re.fullmatch(r"(ST)?(C)?(N)?OFF(\d*)", head[0], re.ASCII)
    if not match:
        raise CloudFileError("is not an OFF file (its first line is not 'OFF')")
    if "BINARY" in head:
        raise CloudFileError("is a binary OFF, which is not supported: write it as text, or as .ply")
    counts = [word for word in (match[4], *head[1:]) if word] or next(rows, [])
    if len(counts) < 2 or not all(c.isascii() and c.isdigit() for c in counts[:2]):
        raise CloudFileError(f"line {lines.number}: expected the numbers of vertices and faces")
    promised = int(counts[0]), int(counts[1])
    vertices, colors = [], []
    skip = 6 if match[3] else 3  # with N, a normal stands before the colour
    for row in islice(rows, promised[0]):
        vertices.append(numbers(lines, row[:3], 3))
        if len(row) - skip in (3, 4):
            colors.append(numbers(lines, row[skip:], len(row) - skip))
    faces, face_colors, more = [], [], False
    for first, *rest in islice(rows, promised[1]):
        corners = max(int(numbers(lines, [first], 1)[0]), 0)
        faces.append([int(n) for n in numbers(lines, rest[:corners], corners)])
        more |= len(rest) > corners
        if len(rest) - corners in (3, 4):
            face_colors.append(numbers(lines, rest[corners:], len(rest) - corners))
    if (len(vertices), len(faces)) != promised:
        raise CloudFileError(
            f"promises {promised[0]} vertices and {promised[1]} faces, holds {len(vertices)} and {len(faces)}, "
            "it is truncated: copy it again"
        )
    left_out = ["normals of the vertices"] if match[3] else []
    left_out += ["texture coordinates"] if match[1] else []
    if more and (colors or len(face_colors) != len(faces)):
        left_out.append("colours of the faces")
    return Parsed(vertices, faces, colors, face_colors, tuple(left_out))


def read_obj(lines: Lines) -> Parsed:
    """v with or without a colour after x y z, and f. Textures, normals of vertices and materials are left out."""
    vertices: list[list[float]] = []
    colors: list[list[float]] = []
    faces: list[list[int]] = []
    others: set[str] = set()
    for kind, *rest in words_of(lines):
        if kind == "v":
            vertices.append(numbers(lines, rest[:3], 3))
            if len(rest) in (6, 7):
                colors.append(numbers(lines, rest[3:], len(rest) - 3))
        elif kind == "f":
            corners = [int(n) for n in numbers(lines, [word.split("/")[0] for word in rest], len(rest))]
            faces.append([n - 1 if n > 0 else len(vertices) + n for n in corners])
        else:
            others.add(kind)
    known = {"vt": "texture coordinates", "vn": "normals of the vertices", "usemtl": "materials", "l": "lines"}
    return Parsed(vertices, faces, colors, [], tuple(text for kind, text in known.items() if kind in others))


def read_text_stl(lines: Lines) -> Parsed:
    vertices = [numbers(lines, words[1:4], 3) for words in words_of(lines) if words[0].lower() == "vertex"]
    if not vertices or len(vertices) % 3 or not lines.last.strip().lower().startswith("endsolid"):
        raise CloudFileError("is not a complete STL file, it is truncated or damaged: copy it again")
    return Parsed(vertices, np.arange(len(vertices)).reshape(-1, 3).tolist(), [], [])


def read_binary_stl(path: Path) -> Mesh | None:
    """None where it is a text file. Binary files may begin with "solid" too, so the size decides."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
        count = int.from_bytes(head[80:], "little")
        if size < 84 + 50 * count or len(head) < 84:
            if head[:5].lower() == b"solid":
                return None
            raise CloudFileError(
                f"promises {count} triangles and is too short for them, it is truncated: copy it again"
            )
        records = np.fromfile(
            file, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flag", "<u2")]), count
        )
    left_out = ("the triangles' attribute bytes",) if records["flag"].any() else ()
    return Mesh(PointCloud(records["corners"].reshape(-1, 3), left_out=left_out), np.arange(3 * count).reshape(-1, 3))


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


def fan(
    faces: Sequence[Sequence[int]] | np.ndarray, of_faces: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(M, 3) triangles of polygons with any number of corners, and the polygons' attributes for each triangle.

    Polygons with fewer than three corners are left out.
    """
    if isinstance(faces, np.ndarray):
        groups = [(faces.astype(np.int64), np.arange(len(faces)))]
    else:
        lengths = np.fromiter(map(len, faces), np.int64, len(faces))
        which = [np.flatnonzero(lengths == k) for k in np.unique(lengths)]
        groups = [(np.array([faces[i] for i in index.tolist()], np.int64), index) for index in which]
    triangles, origin = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for corners, index in groups:
        if corners.ndim == 2 and corners.shape[1] >= 3:
            second, third = corners[:, 1:-1].T, corners[:, 2:].T  # all polygons' first triangles come first
            first = np.broadcast_to(corners[:, 0], second.shape)
            triangles.append(np.stack([first, second, third], -1).reshape(-1, 3))
            origin.append(np.tile(index, len(second)))
    face = np.concatenate(origin)
    return np.concatenate(triangles), {name: values[face] for name, values in of_faces.items()}
