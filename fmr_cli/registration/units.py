"""Two clouds in two units of length: the factor between them, and whether they seem to be so."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fmr_cli.errors import OptionsError

if TYPE_CHECKING:
    import numpy as np

METRES = {
    "m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "in": 0.0254, "ft": 0.3048, "us-ft": 1200 / 3937,
    "yd": 0.9144, "mi": 1609.344,
}  # fmt: skip

# How many of the one are one of the other
UNITS = {
    1000.0: ("metres", "millimetres"), 100.0: ("metres", "centimetres"), 10.0: ("centimetres", "millimetres"),
    25.4: ("inches", "millimetres"), 39.3701: ("metres", "inches"), 3.28084: ("metres", "feet"),
    304.8: ("feet", "millimetres"), 12.0: ("feet", "inches"),
}  # fmt: skip
SHORT = {"metres": "m", "millimetres": "mm", "centimetres": "cm", "inches": "in", "feet": "ft"}
TOLERANCE = 1.25  # two scans of one place differ in size as well


def unit_hint(source: np.ndarray, target: np.ndarray) -> str | None:
    """The units that two clouds (N, 3) of one thing seem to be in, where their sizes are apart as two units are."""
    import numpy as np

    sizes = [float(np.median(np.linalg.norm(points - np.median(points, 0), axis=1))) for points in (source, target)]
    if min(sizes) <= 0:
        return None
    ratio = max(sizes) / min(sizes)
    factor = min(UNITS, key=lambda known: abs(np.log(known / ratio)))
    if abs(np.log(factor / ratio)) > np.log(TOLERANCE):
        return None
    coarse, fine = UNITS[factor]
    units = (coarse, fine) if sizes[0] < sizes[1] else (fine, coarse)
    short = ":".join(SHORT[unit] for unit in units)
    return (
        f"the target is {sizes[1] / sizes[0]:.3g} times as large as the source, as if the source were in {units[0]} "
        f"and the target in {units[1]}: say --unit {short}, or let --scale find the factor"
    )


def factor_of(unit: str) -> float:
    """What a source's lengths are multiplied by where ``unit`` is "mm:m": the source's unit, and the target's.

    Raises OptionsError.
    """
    names = [name.strip().lower() for name in unit.split(":")] if isinstance(unit, str) else []
    if len(names) != 2 or not {*names} <= {*METRES}:
        raise OptionsError(f"--unit {unit}: give the source's and the target's, such as mm:m, of {', '.join(METRES)}")
    return METRES[names[0]] / METRES[names[1]]
