"""The files of Redwood and 3DMatch that say which fragments overlap, and how: gt.log and gt.info.

gt.log: ``i j n``, then 4x4, the pose that takes fragment j to fragment i. gt.info: ``i j n``, then 6x6.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import CloudFileError
from fmr_cli.evaluation.datasets.pair import Loaded, Pair
from fmr_cli.io import SUFFIXES, read_cloud
from fmr_cli.io.files import check_readable, reason
from fmr_cli.io.transforms import as_transform, number_rows

EVALUATION = "-evaluation"  # SCENE-evaluation/gt.log beside SCENE/, as 3DMatch is downloaded


def read_blocks(path: Path, size: int) -> dict[tuple[int, int], np.ndarray]:
    """(i, j) -> (size, size) of a gt.log (4) or gt.info (6). Raises CloudFileError."""
    check_readable(path)
    rows = list(number_rows(path))
    if len(rows) % (size + 1):
        raise CloudFileError(f"{path}: {len(rows)} rows are no multiple of {size + 1}, i j n and {size} rows a pair")
    blocks = {}
    for start in range(0, len(rows), size + 1):
        head, block = rows[start], rows[start + 1 : start + size + 1]
        if len(head) != 3 or any(len(row) != size for row in block):
            raise CloudFileError(f"{path}: pair {start // (size + 1) + 1} is not i j n and {size} rows of {size}")
        blocks[int(head[0]), int(head[1])] = np.array(block)
    return blocks


def read_fragment(path: Path) -> np.ndarray:
    """(N, 3) float64 of a fragment: any point cloud, or a .pth with one array, as Predator distributes 3DMatch."""
    if path.suffix != ".pth":
        return read_cloud(path, attributes=False).points
    check_readable(path)
    import torch

    try:
        # All that a pickled array is made of, and nothing else is allowed to run
        rebuild = np.zeros(0).__reduce__()[0]
        allowed: list[Any] = [rebuild, np.ndarray, np.dtype, np.dtypes.Float32DType, np.dtypes.Float64DType]
        with torch.serialization.safe_globals(allowed):
            points = np.asarray(torch.load(path, weights_only=True), dtype=np.float64)
    except Exception as error:
        raise CloudFileError(f"{path}: holds no plain array of points ({reason(error)}), save it as .npy") from None
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise CloudFileError(f"{path}: has the shape {points.shape}, points are (N, 3)")
    return points


def fragment_files(folder: Path, stem: str) -> dict[int, Path]:
    """The fragments of a folder, STEM_0.ply, STEM_1.ply, ..., by their number."""
    found = {}
    for file in sorted(folder.glob(f"{stem}_*")):
        number = file.stem.removeprefix(f"{stem}_")
        if number.isdecimal() and file.suffix.lower() in (*SUFFIXES, ".pth"):
            found[int(number)] = file
    return found


def logs(paths: Iterable[Path]) -> list[Path]:
    return sorted({log for path in paths if path.is_dir() for log in path.rglob("gt.log")})


def scene_of(log: Path) -> str:
    return log.parent.name.removesuffix(EVALUATION)


def fragments_of(log: Path, paths: Sequence[Path], stem: str) -> dict[int, Path]:
    """The fragments that a gt.log speaks of: beside it, or in a folder of its scene's name anywhere in the paths."""
    scene = scene_of(log)
    folders = [log.parent, *(f for path in paths for f in sorted(path.rglob(scene)) if f.is_dir())]
    folders += [path for path in paths if path.resolve().name == scene]
    for folder in folders:
        if files := fragment_files(folder, stem):
            return files
    return {}


def has_fragments(paths: Sequence[Path], stem: str) -> bool:
    return any(next(path.rglob(f"{stem}_*"), None) for path in paths if path.is_dir())


def pairs_of(log: Path, paths: Sequence[Path], stem: str, info: bool) -> list[Pair]:
    """The pairs of a gt.log. info: with the information of gt.info, which has to be there. Raises CloudFileError."""
    scene, files = scene_of(log), fragments_of(log, paths, stem)
    if not files:
        raise CloudFileError(f"{log}: no fragments {stem}_*.ply of {scene} beside it, give their folder as well")
    poses = read_blocks(log, 4)
    matrices = read_blocks(log.with_name("gt.info"), 6) if info else {}
    found = []
    for (i, j), T in poses.items():
        for number in (i, j):
            if number not in files:
                raise CloudFileError(
                    f"{log}: speaks of fragment {number}, which is not in {next(iter(files.values())).parent}"
                )
        if info and (i, j) not in matrices:
            raise CloudFileError(f"{log.with_name('gt.info')}: lacks the pair {i} {j} of {log.name}")
        found.append(one_pair(scene, files[j], files[i], as_transform(T), matrices.get((i, j))))
    return found


def one_pair(scene: str, source: Path, target: Path, T: np.ndarray, matrix: np.ndarray | None) -> Pair:
    return Pair(
        scene, source.stem, target.stem, lambda: Loaded(read_fragment(source), read_fragment(target), T, matrix)
    )
