"""What `align_many` gives: a pose and a word for each scan, a row for each link, and what keeps components apart."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fmr_cli.geometry.frames import Frame, leave_frames
from fmr_cli.multiway.links import Link
from fmr_cli.multiway.scans import Scan
from fmr_cli.registration.result import plain, versions


@dataclass
class Placed:
    """What became of one scan.

    status: "placed", "unplaced" (no sure link to another one), "failed" (cannot be read or registered at all).
    component: from 0, the largest first, or None. T_component_scan: (4, 4) float64, file's coordinates of the scan to
    its component's frame, or None; T_component_scan_graph: the same before the joint refinement. links: how many join
    it. residual: root mean square point-to-plane distance to the scans it overlaps, file's unit. covariance: (6, 6) of
    a twist (rotation, translation) about the scan's mean, in the scan's axes, relative to the component's frame;
    sigma_rot_deg, sigma_shift: its largest standard deviations.
    """

    name: str
    file: str
    status: Literal["placed", "unplaced", "failed"]
    component: int | None = None
    T_component_scan: np.ndarray | None = None
    T_component_scan_graph: np.ndarray | None = None
    links: int = 0
    residual: float = float("nan")
    covariance: np.ndarray | None = None
    message: str = ""

    @property
    def sigma_rot_deg(self) -> float:
        return float("nan") if self.covariance is None else float(np.degrees(np.sqrt(largest(self.covariance[:3, :3]))))

    @property
    def sigma_shift(self) -> float:
        return float("nan") if self.covariance is None else float(np.sqrt(largest(self.covariance[3:, 3:])))


def largest(block: np.ndarray) -> float:
    return max(float(np.linalg.eigvalsh(block)[-1]), 0.0)


@dataclass
class Apart:
    """The best pose that would join two components, and what speaks against it."""

    first: int
    second: int
    source: str
    target: str
    probability: float
    reason: str


@dataclass
class Network:
    """Many scans and their links.

    scans: in natural order of their names. links: one a pair tried; their poses are between centred frames (``pose``
    has them in files' coordinates). anchors: by component, the scan whose frame is the component's, or None where fixed
    scans give it. apart: what would join components. counts: pairs looked at and registered; seconds: by stage.
    """

    scans: list[Placed]
    links: list[Link]
    anchors: list[str | None]
    apart: list[Apart]
    frames: dict[int, Frame]
    counts: dict[str, int]
    seconds: dict[str, float]
    settings: dict[str, Any] = field(default_factory=dict)
    sources: list[Scan] = field(default_factory=list)

    @property
    def components(self) -> list[list[int]]:
        """The scans of each component, by number."""
        return [[n for n, s in enumerate(self.scans) if s.component == c] for c in range(len(self.anchors))]

    @property
    def whole(self) -> bool:
        """Whether one component holds every scan."""
        return all(scan.component == 0 for scan in self.scans)

    def pose(self, link: Link) -> np.ndarray:
        """T_target_source (4, 4) of a link in files' coordinates."""
        return leave_frames(link.T_target_source, self.frames[link.source], self.frames[link.target])

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON types."""
        return plain({
            "scans": [{**vars(s), "sigma_rot_deg": s.sigma_rot_deg, "sigma_shift": s.sigma_shift} for s in self.scans],
            "links": [self.link_dict(link) for link in self.links],
            "components": [
                {"anchor": anchor, "scans": [self.scans[n].name for n in members]}
                for anchor, members in zip(self.anchors, self.components, strict=True)
            ],
            "apart": [vars(apart) for apart in self.apart],
            "counts": self.counts, "seconds": self.seconds, "settings": self.settings, "versions": versions(),
        })  # fmt: skip

    def link_dict(self, link: Link) -> dict[str, Any]:
        said = {name: value for name, value in vars(link).items() if name not in ("hypotheses", "source", "target")}
        hypotheses = [
            {
                "T_target_source": leave_frames(h.T_target_source, self.frames[link.source], self.frames[link.target]),
                "confidence": h.confidence,
            }
            for h in link.hypotheses
        ]
        return {"source": self.scans[link.source].name, "target": self.scans[link.target].name, **said,
                "confidence": link.confidence, "hypotheses": hypotheses}  # fmt: skip
