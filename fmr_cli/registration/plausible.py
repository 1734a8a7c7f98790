"""What is wrong with the numbers of a cloud rather than with its scene: points far outside, another unit."""

from __future__ import annotations

import numpy as np

# Times the distance from the middle within which 90 % of the points lie: a scan's farthest point is at some ten times,
# an invalid one that a scanner or a program has put at 1e6 and more is beyond.
FAR = 1000.0
LOOKED_AT = 20_000  # points that the middle and that distance are told by
# How many of the one are one of the other
UNITS = {
    1000.0: ("metres", "millimetres"), 100.0: ("metres", "centimetres"), 10.0: ("centimetres", "millimetres"),
    25.4: ("inches", "millimetres"), 39.3701: ("metres", "inches"), 3.28084: ("metres", "feet"),
    304.8: ("feet", "millimetres"), 12.0: ("feet", "inches"),
}  # fmt: skip
TOLERANCE = 1.25  # two scans of one place differ in size as well


def without_far_points(points: np.ndarray) -> tuple[np.ndarray, str | None]:
    """The points (N, 3) without those beyond FAR times the cloud's reach, and a word on these where there are some."""
    if len(points) == 0:
        return points, None
    some = points[:: -(-len(points) // LOOKED_AT)]
    middle = np.median(some, axis=0)
    reach = float(np.quantile(np.abs(some - middle).max(1), 0.9))
    distance = np.abs(points - middle).max(1)
    far = distance > FAR * reach
    if reach == 0 or not far.any():
        return points, None
    what = f"{far.sum()} points lie" if far.sum() > 1 else "1 point lies"
    return points[~far], (
        f"{what} up to {distance.max():.2g} from the middle of the cloud, {distance.max() / reach:.1g} times as far as "
        "most: left out of the registration, remove what is invalid"
    )


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
        f"the target is {sizes[1] / sizes[0]:.3g} times as large as the source, as if the source were in {units[0]} and "
        f"the target in {units[1]}: bring them to one unit, or let --scale find the factor"
    )
