"""How to register: every option of a pair, checked where it is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from fmr_cli.errors import FmrError
from fmr_cli.geometry.dof import Dof

if TYPE_CHECKING:
    import numpy as np

Init = Literal["auto", "search", "features", "centroid", "identity"]
STARTS = get_args(Init)


@dataclass(frozen=True)
class Options:
    """How to register. Every length is in the clouds' own unit; None means: taken from the data.

    voxel_size: the working voxel edge, or None.
    normalize: scale the clouds to the encoder's unit box (half extent 0.5); without it they are taken to be so scaled.
    points: how many points of each cloud the global encoder sees.
    init: where to start: "auto" (cheap starts first, more while the verdict is not sure), "search" (rotations spread
        over SO(3)), "features" (matched local patches), "centroid", "identity", or a 4x4 T_target_source.
    iterations: of the IC solver from a given start, at most.
    robust: robust steps on both clouds' Jacobians, or the paper's plain ones on the target's (``solver``).
    refine: finish with a geometric polish (GICP).
    model: the global encoder's weights (.safetensors), or None for the bundled ones.
    device: "cpu", "cuda" or "auto" (the CPU): where the solver of the global feature runs.
    seed: of every random choice; the same seed gives the same answer.
    dof: "rigid", "yaw" (rotation about ``up``, any translation), "translation", "planar" (yaw, and no shift along up).
    up: the vertical, any length. scale: also estimate one scale factor.
    max_angle: degrees; max_shift: how far the source's centre may move. Poses beyond are not considered.
    """

    voxel_size: float | None = None
    normalize: bool = True
    points: int = 1024
    init: Init | np.ndarray = "auto"
    iterations: int = 10
    robust: bool = True
    refine: bool = True
    model: Path | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    dof: Dof = "rigid"
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    scale: bool = False
    max_angle: float | None = None
    max_shift: float | None = None


def read_init(text: str, folder: Path = Path()) -> Any:
    """The name of a start, or the matrix in a transform file (relative to ``folder``). Raises FmrError."""
    if text in STARTS:
        return text
    if not (folder / text).is_file():
        raise FmrError(f"{text}: is no start ({', '.join(STARTS)}) and no transform file, check --init")
    from fmr_cli.io import read_transform

    return read_transform(folder / text)
