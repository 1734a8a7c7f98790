"""What a registration gives: the transform and everything said about it."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy

import fmr_cli
from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.geometry import observability
from fmr_cli.registration.confidence import ALIGNED, LIKELY, Candidate, doubts
from fmr_cli.registration.options import Options
from fmr_cli.registration.pair import Pair
from fmr_cli.registration.prepared import Prepared
from fmr_cli.registration.refinement import roughnesses

RIVALLING = 0.1  # of the best one's weight, that an alternative has at least


@dataclass
class Registration:
    """A transform and everything said about it.

    T_target_source: (4, 4) float64, x_target = s R x_source + t, in the clouds' own unit; s is 1 unless asked for.
    status: "aligned", or "uncertain" where the evidence at the pose speaks against it.
    confidence: the probability, from 0 to 1, that the pose is right; poses that fit as well share it.
    overlap: share of the smaller cloud's points that have a counterpart in the other one.
    inlier_rmse: root mean square distance of those to the surface of their counterparts, own unit.
    feature_error_before, feature_error_after: mean |F(g Q) - F(P)| of the global feature as the files are, and at T.
    feature_errors: the same before each iteration of the IC solver that led to T, and after its last; empty where T
        came from local features.
    feature_check: where asked for, "errors" as above of a few iterations from T, and by how far they move it: "angle"
        in degrees and "shift" of the source's centre, own unit. What only one scan saw pulls at a global feature, so at
        part overlap they do move it.
    start: which start the pose came from ("identity", "centroid", "search", "features", "given"); "site" where both
        scans were found on a site that the model knows.
    angle: rotation angle of T, degrees. shift: how far T moves the source's centre, own unit.
    information: (6, 6) of a twist (rotation, translation) in the target's frame about ``origin`` (3,), the target's
        mean; rad⁻² and unit⁻². covariance: its inverse over the directions that are determined.
    undetermined: the directions that the scans hardly determine, in words.
    alternatives: other poses that would be called aligned if alone, as of a symmetric shape, best first:
        T_target_source, confidence, feature_error.
    reasons: why the status is not "aligned", in words. evidence: what the verdict is made of.
    mirrored: whether T mirrors, which only ``options.allow_mirror`` allows.
    points: points read and points used. seconds: wall time by stage, and total.
    """

    T_target_source: np.ndarray
    status: Literal["aligned", "uncertain"]
    confidence: float
    overlap: float
    inlier_rmse: float
    feature_error_before: float
    feature_error_after: float
    feature_errors: list[float]
    start: str
    angle: float
    shift: float
    scale: float
    information: np.ndarray
    covariance: np.ndarray
    origin: np.ndarray
    undetermined: list[str]
    alternatives: list[dict[str, Any]]
    evidence: dict[str, float]
    voxel_size: float
    points: dict[str, int]
    options: Options
    seconds: dict[str, float] = field(default_factory=dict)
    feature_check: dict[str, Any] = field(default_factory=dict)
    mirrored: bool = False
    reasons: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON types, with the versions it was made by."""
        said = {name: plain(value) for name, value in vars(self).items() if name != "options"}
        options = plain(asdict(self.options))
        said |= {"iterations": max(len(self.feature_errors) - 1, 0), "options": options, "versions": versions()}
        return said


def describe(
    pair: Pair,
    best: Candidate,
    others: list[Candidate],
    source: Prepared,
    factor: float,
    options: Options,
    polish: observability.Observations | None = None,
) -> Registration:
    """The best candidate in the files' coordinates, with its covariance and alternatives.

    source: as it came; pair.source is that, every length multiplied by ``factor``. polish: see ``certainty``.
    """
    T = pair.leave_centred(best.T_target_source)
    T[:3, :3] *= factor
    noise = [cloud.noise for cloud in roughnesses(pair)]
    eyes = (pair.source.eye, pair.target.eye)
    certain = observability.certainty(pair.s, pair.t, best.T_target_source, np.zeros(3), noise, eyes, polish)
    rivals = [c for c in others if c.support >= LIKELY and c.weight >= RIVALLING * best.weight]
    points = smaller(pair, best.T_target_source)
    centre = points.mean(0)
    twists = observability.weak_twists(observability.about(certain.information, centre), points - centre, in_use(pair))
    if twists.size:  # of most pairs none is weak
        twists = observability.unopposed(twists, pair.s, pair.t, best.T_target_source, centre)
    weak = observability.in_words(twists)
    aligned = best.confidence >= ALIGNED and not weak
    reasons = [f"the scans do not determine: {'; '.join(weak)}"] if weak else []
    alternatives = [
        {
            "T_target_source": pair.leave_centred(c.T_target_source).tolist(),
            "confidence": c.confidence,
            "feature_error": pair.feature_error(c.T_target_source),
        }
        for c in rivals
    ]
    read = {"source": source.read, "target": pair.target.read}
    return Registration(
        T_target_source=T,
        status="aligned" if aligned else "uncertain",
        confidence=best.confidence,
        overlap=best.evidence.overlap,
        inlier_rmse=best.evidence.inlier_rmse,
        feature_error_before=pair.feature_error(pair.enter_centred(np.eye(4))),
        feature_error_after=pair.feature_error(best.T_target_source),
        feature_errors=best.errors,
        start=best.start,
        angle=angle_degrees(T),
        shift=float(np.linalg.norm(transform_points(T, source.centre[None])[0] - source.centre)),
        scale=float(np.cbrt(np.linalg.det(T[:3, :3]))),
        information=np.linalg.pinv(certain.covariance, rcond=1e-12, hermitian=True),
        covariance=certain.covariance,
        origin=pair.target.centre,
        undetermined=weak,
        alternatives=alternatives,
        evidence=asdict(best.evidence),
        voxel_size=pair.edge,
        points={**read, "source_used": len(pair.s.points), "target_used": len(pair.t.points)},
        options=options,
        reasons=[] if aligned else [*reasons, *doubts(pair, best, rivals)],
    )


def smaller(pair: Pair, T_target_source: np.ndarray) -> np.ndarray:
    """The points (N, 3) of the cloud that reaches less far, in the target's centred frame.

    What a turn does is seen there: about the far centre of a map, a scan's turn is hardly told from its shift.
    """
    source, target = (np.abs(x.points - x.points.mean(0)).max() for x in (pair.s, pair.t))
    return transform_points(T_target_source, pair.s.points) if source < target else pair.t.points


def in_use(pair: Pair) -> np.ndarray:
    """The twists (6, d) that the motion may use: those of the options; of flat scans those within their plane."""
    if pair.flat_planes is None or pair.motion.dof != "rigid":
        return pair.motion.basis()
    normal = pair.flat_planes[1]
    across = np.linalg.svd(normal[None])[2][1:].T
    return np.block([[normal[:, None], np.zeros((3, 2))], [np.zeros((3, 1)), across]])


class Stopwatch:
    """Wall time by stage, and since it was made."""

    def __init__(self) -> None:
        self.begin = time.perf_counter()
        self.stages: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the wall time of its block to the stage's."""
        start = time.perf_counter()
        yield
        self.stages[name] = self.stages.get(name, 0.0) + time.perf_counter() - start

    @property
    def seconds(self) -> dict[str, float]:
        """Of every stage, and "total"."""
        return {**self.stages, "total": time.perf_counter() - self.begin}


def plain(value: Any) -> Any:
    """The value in JSON's types; what is not finite becomes None, since JSON has no word for it."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def versions() -> dict[str, str]:
    """What could change a result: this tool, the libraries that compute, Python and the processor's architecture."""
    return {
        "fmr": fmr_cli.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
