"""Whether two clouds seem to be in two units of length."""

from __future__ import annotations

import numpy as np

# How many of the one are one of the other
UNITS = {
    1000.0: ("metres", "millimetres"), 100.0: ("metres", "centimetres"), 10.0: ("centimetres", "millimetres"),
    25.4: ("inches", "millimetres"), 39.3701: ("metres", "inches"), 3.28084: ("metres", "feet"),
    304.8: ("feet", "millimetres"), 12.0: ("feet", "inches"),
}  # fmt: skip
TOLERANCE = 1.25  # two scans of one place differ in size as well


def unit_hint(source: np.ndarray, target: np.ndarray) -> str | None:
    """The units that two clouds (N, 3) of one thing seem to be in, where their sizes are apart as two units are."""
    sizes = [float(np.median(np.linalg.norm(points - np.median(points, 0), axis=1))) for points in (source, target)]
    if min(sizes) <= 0:
        return None
    ratio = max(sizes) / min(sizes)
    factor = min(UNITS, key=lambda known: abs(np.log(known / ratio)))
    if abs(np.log(factor / ratio)) > np.log(TOLERANCE):
        return None
    coarse, fine = UNITS[factor]
    units = (coarse, fine) if sizes[0] < sizes[1] else (fine, coarse)
    return (
        f"the target is {sizes[1] / sizes[0]:.3g} times as large as the source, as if the source were in {units[0]} "
        f"and the target in {units[1]}: bring them to one unit, or let --scale find the factor"
    )
