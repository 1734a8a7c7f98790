"""Which attributes of a cloud are vectors, by their names, and how each kind moves with the points.

A vector is three attributes named alike but for x, y, z (``nx ny nz``, ``NormalX NormalY NormalZ``), or one (N, 3).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

# The name without its x, y or z, in small letters without _ - . and blanks -> what a transform does to it
DIRECTIONS = ("n", "nor", "norm", "normal", "normals", "pointnormal", "vertexnormal", "dir", "direction",
              "ray", "raydir", "raydirection", "beam", "beamdir", "beamdirection", "scandir", "scandirection",
              "viewdir", "viewdirection", "lineofsight",
              "tangent", "axis")  # fmt: skip
# t: the LAS waveform's direction, coordinates per picosecond. d: scan direction or flow; both turn
DISPLACEMENTS = ("v", "vel", "velocity", "velocities", "speed", "flow", "sceneflow", "motion", "displacement", "d",
                 "offset", "t", "acc", "acceleration")  # fmt: skip
POSITIONS = ("origin", "sensor", "sensororigin", "sensorposition", "scanner", "scannerposition", "beamorigin",
             "viewpoint", "station", "o", "shooter")  # fmt: skip
KINDS = dict.fromkeys(DIRECTIONS, "direction") | dict.fromkeys(DISPLACEMENTS, "displacement")
KINDS |= dict.fromkeys(POSITIONS, "position")
# Angles about an axis of the frame: a rotation changes them, and which convention they follow no name says.
ANGLES = ("azimuth", "heading", "yaw", "pitch", "roll", "dip", "dipdirection", "strike", "trend", "plunge")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")  # Gaussian splats: a quaternion w x y z
LOG_SCALE = ("scale_0", "scale_1", "scale_2")  # Gaussian splats: natural logarithms of lengths


class Vector(NamedTuple):
    """names: three attributes, or one of shape (N, 3). kind: direction, displacement, position, or unknown."""

    names: tuple[str, ...]
    kind: str


def find_vectors(attributes: Mapping[str, np.ndarray]) -> list[Vector]:
    """The vectors among a cloud's attributes. Integers of unknown meaning, such as colours, are none."""
    found = []
    for name, values in attributes.items():
        if values.ndim == 2 and values.shape[1] == 3:
            kind = KINDS.get(stem(name), "unknown")
            if kind != "unknown" or values.dtype.kind == "f":
                found.append(Vector((name,), kind))
        elif values.ndim == 1 and (rest := re.fullmatch(r"[xX](.+)|(.+)[xX](\W?\w*\)?)?|(.+_)0", name)):
            names = next((n for n in spellings(name, rest) if all(m in attributes for m in n)), None)
            if names is None or names == LOG_SCALE:
                continue
            kind = KINDS.get(stem(shared(names)), "unknown")
            fractions = all(attributes[n].dtype.kind == "f" for n in names)
            if kind != "unknown" or (fractions and not names[0].endswith("0")):
                found.append(Vector(names, kind))
    return found


def spellings(name: str, rest: re.Match[str]) -> Iterable[tuple[str, ...]]:
    """The triples that a name may begin: x at its start or end, or 0 at its end."""
    if rest[1]:
        yield tuple(letter + rest[1] for letter in ("xyz" if name[0] == "x" else "XYZ"))
    if name[-1] in "xX":
        yield tuple(name[:-1] + letter for letter in ("xyz" if name[-1] == "x" else "XYZ"))
    if rest[4]:
        yield tuple(f"{rest[4]}{k}" for k in range(3))


def shared(names: tuple[str, ...]) -> str:
    """What the three names have in common."""
    a, b, _ = names
    return a[1:] if a[1:] == b[1:] else a[:-1]


def stem(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower().removeprefix("scalar_"))


def turn_vectors(attributes: dict[str, np.ndarray], T: np.ndarray) -> dict[str, np.ndarray]:
    """The attributes after the points moved by T (4x4, a rotation, perhaps with a mirror, times one scale)."""
    scale = float(np.cbrt(abs(np.linalg.det(T[:3, :3]))))
    R = T[:3, :3] / scale
    moves: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "direction": lambda v: v @ R.T,
        "displacement": lambda v: v @ T[:3, :3].T,
        "position": lambda v: v @ T[:3, :3].T + T[:3, 3],
    }
    result = dict(attributes)
    for names, kind in find_vectors(attributes):
        if kind in moves:
            put(result, names, moves[kind](stacked(attributes, names)))
    if all(name in attributes for name in ROTATION):
        put(
            result, ROTATION, turned_quaternions(stacked(attributes, ROTATION), R * np.sign(np.linalg.det(R)))
        )  # ellipsoids are symmetric
    if all(name in attributes for name in (*ROTATION, *LOG_SCALE)):
        put(result, LOG_SCALE, stacked(attributes, LOG_SCALE) + np.log(scale))
    rest = harmonics(attributes)
    if rest:
        coefficients = stacked(attributes, rest).reshape(len(attributes[rest[0]]), 3, -1)
        turned = coefficients @ turned_harmonics(coefficients.shape[2], R).T
        put(result, rest, turned.reshape(len(turned), -1))
    return result


def unturned(attributes: Mapping[str, np.ndarray]) -> list[str]:
    """Warnings about attributes that look like vectors or angles and that `turn_vectors` leaves as they are."""
    warnings = [
        f"attribute {', '.join(names)} looks like a vector and is not turned with the points: its name says not which"
        for names, kind in find_vectors(attributes)
        if kind == "unknown"
    ]
    angles = [name for name in attributes if re.sub(r"(deg|degrees|rad)$", "", stem(name)) in ANGLES]
    if angles:
        warnings.append(f"attribute {', '.join(angles)} looks like an angle in the old frame and is not changed")
    if any(name.startswith("f_rest_") for name in attributes) and not harmonics(attributes):
        warnings.append("spherical harmonics f_rest_* of an unknown degree are not turned with the points")
    return warnings


def stacked(attributes: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    """(N, k) float64 of k attributes, or of one (N, k)."""
    if len(names) == 1:
        return attributes[names[0]].astype(np.float64)
    return np.stack([attributes[name] for name in names], 1).astype(np.float64)


def put(attributes: dict[str, np.ndarray], names: tuple[str, ...], values: np.ndarray) -> None:
    """The reverse of `stacked`, in each attribute's own type."""
    columns = [values] if len(names) == 1 else values.T
    for name, column in zip(names, columns, strict=True):
        kind = attributes[name].dtype
        attributes[name] = (np.rint(column) if kind.kind in "iu" else column).astype(kind)


def turned_quaternions(q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The rotation R (3x3) after each of q (N, 4), w x y z of any length, which is kept."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return q @ left.T


def harmonics(attributes: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """f_rest_0, f_rest_1, ... of Gaussian splats of degree 1 to 3, or none: three colours, all coefficients of each."""
    names = tuple(f"f_rest_{k}" for k in range(sum(name.startswith("f_rest_") for name in attributes)))
    return names if len(names) in (9, 24, 45) and all(name in attributes for name in names) else ()


def turned_harmonics(count: int, R: np.ndarray) -> np.ndarray:
    """(count, count): takes the coefficients of a function f(d) to those of f(R^T d), by a fit to many directions."""
    d = np.random.default_rng(0).normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return np.linalg.pinv(basis(d)[:, :count]) @ basis(d @ R)[:, :count]


def basis(d: np.ndarray) -> np.ndarray:
    """Real spherical harmonics of degree 1 to 3 at unit vectors: (N, 3) -> (N, 15).

    Order and signs of 3D Gaussian Splatting (Kerbl et al. 2023); constant factors of a whole degree are left out, they
    cancel.
    """
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    a, b, c, e = np.sqrt([3.0, 15.0, 2.5, 1.5])  # relative norms within degree 2 (a) and 3 (b, c, e)
    return np.stack([
        -y, z, -x,
        2 * a * x * y, -2 * a * y * z, 2 * zz - xx - yy, -2 * a * x * z, a * (xx - yy),
        -c * y * (3 * xx - yy), 2 * b * x * y * z, -e * y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy),
        -e * x * (4 * zz - xx - yy), b * z * (xx - yy), -c * x * (xx - 3 * yy),
    ], 1)  # fmt: skip
