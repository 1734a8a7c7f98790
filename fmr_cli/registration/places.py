"""A scan in a map: where the target reaches much further than the source, its parts are looked at one by one.

Whole, so large a target would be seen on voxels too coarse for the scan, by too few keypoints for any one place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from fmr_cli.geometry.sampling import WITHIN
from fmr_cli.registration.options import Options
from fmr_cli.registration.prepared import MIN_POINTS, Prepared

FROM = 2.5  # times the source's reach, from which the target is taken for a map: below, one look at all of it is enough
WIDTH, STEP = 3.0, 1.5  # of a part, and from one to the next, in reaches: some part holds nearly all that a scan saw
MOST_PARTS = 400  # a reach that gives more is hardly that of a scan in a map: a tea cup and a street
FEWEST = 20 * MIN_POINTS  # points of a part that is worth a look


def is_map(source: Prepared, target: Prepared, options: Options) -> bool:
    """Whether the place of the source in the target is to be sought part by part."""
    asked = isinstance(options.init, str) and options.init in ("auto", "features")
    return asked and not options.scale and options.voxel_size is None and target.reach > FROM * source.reach


def parts(source: Prepared, target: Prepared, options: Options) -> Iterator[Prepared]:
    """The target's parts in which the source may lie, of WIDTH reaches; none at all if they were too many.

    With ``options.max_shift``, those alone that it allows.
    """
    size = source.reach
    low, high = np.quantile(target.points, [1 - WITHIN, WITHIN], axis=0)
    steps = [max(math.ceil((b - a) / (STEP * size)), 1) for a, b in zip(low, high, strict=True)]
    if math.prod(steps) > MOST_PARTS:
        return
    for step in product(*(range(n) for n in steps)):
        centre = low + (high - low) * (np.array(step) + 0.5) / steps
        away = np.linalg.norm(np.maximum(np.abs(centre + target.centre - source.centre) - WIDTH / 2 * size, 0))
        if options.max_shift is not None and away > options.max_shift:
            continue
        inside = (np.abs(target.points - centre) <= WIDTH / 2 * size).all(1)
        if inside.sum() >= FEWEST:
            yield target.part(inside)
