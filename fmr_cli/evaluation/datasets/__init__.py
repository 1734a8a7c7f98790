"""Data sets as the field lays them out: a module a layout, which finds its pairs and says when a pose is right.

Each has ``recognise(paths)``, whether the folders look like its layout, and ``read(paths, seed)``, a ``DataSet``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from fmr_cli.errors import FmrError
from fmr_cli.evaluation.datasets.pair import DataSet

# The name that is typed -> the module, in the order in which a folder is looked at.
LAYOUTS = {
    "pairs": "table",
    "3dmatch": "threedmatch",
    "3dlomatch": "threedmatch",
    "eth": "eth",
    "kitti": "kitti",
    "modelnet40": "modelnet40",
    "7scenes": "seven_scenes",
    "poses": "posed",
}


def recognised(paths: Sequence[Path]) -> str | None:
    """The name of the layout that the folders (or the CSV file) have, or None."""
    return next((name for name in LAYOUTS if module(name).recognise(paths)), None)


def read_dataset(name: str, paths: Sequence[Path], seed: int = 0) -> DataSet:
    """The pairs of a data set.

    name: of a layout. paths: its folders, or a CSV file. seed: of pairs that are drawn. Raises FmrError where the name
    is unknown, a path is missing, or the layout is not there.
    """
    if name not in LAYOUTS:
        raise FmrError(f"--dataset {name}: no such layout; choose from {', '.join(LAYOUTS)}")
    for path in paths:
        if not path.exists():
            raise FmrError(f"{path}: no such folder or file, check the name")
    # 3DMatch and 3DLoMatch share a layout; which of the two ground truths is meant is all that differs.
    more = {"benchmark": name} if LAYOUTS[name] == "threedmatch" else {}
    found: DataSet = module(name).read(paths, seed=seed, **more)
    return found


def module(name: str) -> ModuleType:
    """The layout's module, with ``recognise`` and ``read``."""
    return import_module(f"fmr_cli.evaluation.datasets.{LAYOUTS[name]}")
