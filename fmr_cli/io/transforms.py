"""4x4 transforms (.txt, .npy, .json) and KITTI pose files (rows of 12 numbers)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import CloudFileError
from fmr_cli.io.files import atomic_write, check_readable, reason

# Where a transform may be in a JSON object; the first is what write_transform writes.
KEYS = ("T_target_source", "transform", "transformation", "matrix")
LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
TOLERANCE = 1e-2  # other tools write as few as three digits


def read_transform(path: str | Path, mirror: bool = False) -> np.ndarray:
    """The (4, 4) float64 transform of a .npy file, a .json file, or of text with 4x4, 3x4 or 1x12 numbers.

    JSON: four rows, or an object that has them under one of KEYS (such as the file of ``fmr align --metrics``).
    Raises CloudFileError where the shape is another, a number is not finite, the last row is not 0 0 0 1, or the 3x3
    block is no rotation (times one scale); with ``mirror`` it may also be a rotation and a mirror.
    """
    path = Path(path)
    check_readable(path)
    try:
        match path.suffix.lower():
            case ".npy":
                values = np.load(path, mmap_mode="r", allow_pickle=False)
            case ".json":
                values = json_matrix(json.loads(path.read_text("utf-8")))
            case _:
                values = np.array([number for row in number_rows(path) for number in row])
        matrix = as_transform(np.array(values, dtype=np.float64), mirror) if values.size in (12, 16) else None
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}") from error
    except Exception as error:
        raise CloudFileError(f"{path}: cannot be read as a transform ({reason(error)}), give 4 rows of 4") from error
    if matrix is None:
        raise CloudFileError(f"{path}: holds {values.size} numbers, a transform has 4 rows of 4")
    return matrix


def json_matrix(data: Any) -> np.ndarray:
    if isinstance(data, dict):
        key = next((key for key in KEYS if key in data), None)
        if key is None:
            raise CloudFileError(f"has none of {', '.join(KEYS)}, where the transform should be")
        data = data[key]
    return np.array(data, dtype=np.float64)


def as_transform(values: np.ndarray, mirror: bool = False) -> np.ndarray:
    """12 or 16 numbers, row by row, as a checked (4, 4) transform; with ``mirror`` one that mirrors may be."""
    matrix = np.vstack([values.reshape(3, 4), LAST_ROW]) if values.size == 12 else values.reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise CloudFileError("has numbers that are not finite, it is no transform")
    if np.abs(matrix[3] - LAST_ROW).max() > 1e-9:
        raise CloudFileError("its last row is not 0 0 0 1, it is no transform (written column by column?)")
    block = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(block))
    if scale == 0 or (scale < 0 and not mirror) or np.abs(block @ block.T / scale**2 - np.eye(3)).max() > TOLERANCE:
        raise CloudFileError("its 3x3 block is no rotation (times one scale), it would shear or mirror the points")
    return matrix


def write_transform(path: str | Path, T: np.ndarray) -> None:
    """Writes T (4x4) as .npy, as .json, or as 4 rows of 4 with 17 significant digits: it is read back bit for bit."""
    T = np.asarray(T, dtype=np.float64).reshape(4, 4)
    with atomic_write(path) as temporary:
        match Path(path).suffix.lower():
            case ".npy":
                with temporary.open("wb") as file:
                    np.save(file, T)
            case ".json":
                rows = ",\n  ".join(json.dumps(row) for row in T.tolist())
                temporary.write_text(f'{{"{KEYS[0]}": [\n  {rows}\n]}}\n', "utf-8")
            case _:
                temporary.write_text(transform_text(T), "ascii")


def transform_text(T: np.ndarray) -> str:
    """4 lines of 4 numbers with 17 significant digits."""
    return lines_of(np.asarray(T, dtype=np.float64).reshape(4, 4))


def read_poses(path: str | Path) -> np.ndarray:
    """(n, 4, 4) float64 poses of a KITTI file: 12 (or 16) numbers a line. Raises CloudFileError with the line."""
    path = Path(path)
    check_readable(path)
    poses = []
    try:
        for number, row in enumerate(number_rows(path), 1):
            if len(row) not in (12, 16):
                raise CloudFileError(f"pose {number} has {len(row)} numbers, KITTI rows have 12")
            try:
                poses.append(as_transform(np.array(row)))
            except CloudFileError as error:
                raise CloudFileError(f"pose {number}: {error}") from error
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}") from error
    if not poses:
        raise CloudFileError(f"{path}: holds no poses, give one row of 12 numbers a frame")
    return np.stack(poses)


def write_poses(path: str | Path, poses: np.ndarray) -> None:
    """Writes poses (n, 4, 4) as KITTI rows of 12 numbers with 17 significant digits."""
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    with atomic_write(path) as temporary:
        temporary.write_text(lines_of(poses[:, :3].reshape(-1, 12)), "ascii")


def number_rows(path: Path) -> Iterable[list[float]]:
    """The numbers of each line of a text file; blank lines and # comments are skipped."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.split("#")[0].replace(",", " ").split()
            try:
                row = [float(word) for word in words]
            except ValueError:
                raise CloudFileError(f"line {number}: expected numbers, found {line.strip()[:60]!r}") from None
            if row:
                yield row


def lines_of(rows: np.ndarray) -> str:
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows + 0.0)  # + 0.0: no minus zero
