"""What a report says in words: statuses, reasons and what to do about them, poses, directions."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from fmr_cli.cloud import angle_degrees, transform_points
from fmr_cli.geometry.observability import direction

VERDICTS = {
    "aligned": "The scans agree at this pose, and no other pose fits as well.",
    "uncertain": "A pose was found, but something speaks against trusting it. Look at it before you use it.",
    "failed": "No pose was found.",
    "rejected": "Sure by itself, but contradicted by the other links of the network.",
}
# A piece of a reason (see ``registration.confidence.doubts``) -> what to do about it
ADVICE = (
    ("do not determine", "Along the arrows the scans look the same wherever the source is. Add a scan that shows an "
     "end or a corner, or bound the motion with --dof, --max-shift or a pose that you know (--init)."),
    ("fits about as well", "Switch between the poses below and look which one is right; its matrix, saved to a file, "
     "can be given with --init."),
    ("contradicts the pose", "Look at the section for surfaces that cross, or that float before one another. Things "
     "that moved between the scans also do this."),
    ("in one scan alone", "Look there: if it was moved or taken away between the scans, the pose may be right; if it "
     "stands elsewhere in the other scan, it is wrong."),
    ("scaled by", "If the two were not measured in one scale, register them with --scale."),
    ("as far apart as", "The surfaces do not meet as closely as the scans are smooth: one may be bent, drifted or "
     "noisy."),
    ("of the smaller scan lies on", "There is little that both scans saw. A scan taken in between gives two sure "
     "links."),
    ("three planes", "Scan so that both see something besides walls: furniture, pipes, a marker."),
    ("matches of local features", "Few places look alike in both scans: little overlap, few points, or another "
     "place."),
    ("voxel", "Check that both files are in one unit and show one place."),
)  # fmt: skip
EVIDENCE = {
    "explained": ("points explained", "lie on the other surface and face along with it"),
    "contradicted": ("points that contradict", "float off a surface that the other scan saw there"),
    "missing": ("points of missing things", "of the latter, those that lie together: a thing that one scan lacks"),
    "largest": ("points of the largest one", "of those that contradict, the largest cluster of each scan"),
    "overlap": ("overlap", "share of the smaller scan near the other one"),
    "explained_share": ("overlap that is explained", "the same, counting explained points only"),
    "inlier_rmse": ("RMSE", "to the surface of the other scan"),
    "offset": ("offset", "distance between the surfaces over their own roughness; about 1 is as good as can be"),
    "turn": ("turn", "angle between the surfaces over their own unevenness; about 1 is as good as can be"),
    "detail": ("detail", "points explained that lie on none of the three planes of the largest corner"),
    "stretch": ("stretch", "share by which the source would have to grow or shrink to fit better"),
    "votes": ("matching features", "local features that agree with the pose"),
    "repeats": ("repetition", "how much of the scene looks the same elsewhere"),
}
NAMED = re.compile(r"(shift along|rotation about) \(([^)]*)\)")


def advice(reasons: Iterable[str]) -> list[tuple[str, str]]:
    """Each reason with what to do about it."""
    return [(reason, next((text for piece, text in ADVICE if piece in reason), "")) for reason in reasons]


def directions(texts: Iterable[str]) -> list[dict[str, object]]:
    """The directions named in texts such as "shift along (1.00, 0.00, 0.00)": kind, unit vector, the words."""
    found = []
    for match in (m for text in texts for m in NAMED.finditer(text)):
        vector = np.array([float(x) for x in match[2].split(",")])
        if vector.shape == (3,) and np.linalg.norm(vector) > 0:
            found.append({
                "kind": "shift" if match[1].startswith("shift") else "rotation",
                "vector": (vector / np.linalg.norm(vector)).tolist(), "words": match[0],
            })  # fmt: skip
    return found


def motion_words(T: np.ndarray, centre: np.ndarray) -> str:
    """A motion T (4, 4) as a turn and the shift of ``centre`` (3,)."""
    angle, moved = angle_degrees(T), transform_points(T, centre[None])[0] - centre
    R = T[:3, :3] / np.cbrt(np.linalg.det(T[:3, :3]))
    length = float(np.linalg.norm(moved))
    parts = []
    if angle >= 0.05:
        # The axis of a turn by 180 deg has no sign; of others neither matters here.
        axis = np.linalg.eigh(R + R.T)[1][:, 2]
        parts.append(f"turned by {angle:.3g}° about {direction(axis)}")
    if length > 0:
        parts.append(f"shifted by {length:.3g} along {direction(moved)}")
    return ", ".join(parts) or "not moved"


def matrix_text(T: np.ndarray) -> str:
    """A 4x4 as ``fmr`` writes it."""
    return "\n".join(" ".join(f"{value + 0.0:.17g}" for value in row) for row in T)
