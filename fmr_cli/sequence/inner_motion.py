"""The motion within a scan, estimated from how the scan fits the map, together with its pose. Lengths are in voxels."""

from __future__ import annotations

import numpy as np

from fmr_cli.geometry.se3 import exp
from fmr_cli.sequence.local_map import COARSE, FINE, Fit, LocalMap, displacement
from fmr_cli.sequence.moving_scan import MovingScan
from fmr_cli.sequence.observability import LEAST_SIGMA
from fmr_cli.sequence.prepared_scan import PreparedScan

ROUNDS = 3  # of making the scan ready by a better motion, at most
# Of the scan's distance from the map's planes, how far its ends may yet move against each other, half to either side,
# before it is made ready again: a quarter of what noise does.
LEFT = 0.5
# The ends have moved less: what the step has left out is of second order, and within the noise; and thinned points may
# move by as much without being thinned anew, which takes as long as all the rest of a frame.
SETTLED = 0.5 * FINE


def without_motion(
    local_map: LocalMap, scan: PreparedScan, moving: MovingScan, fit: Fit, slope: float, information: np.ndarray
) -> tuple[PreparedScan, MovingScan]:
    """The scan and the motion within it, where it fits the map best; as they are where little changes.

    moving: what ``scan`` was made of; fit: where it is, roughly. slope: see ``plane_map.trust``. information: (6, 6),
    how sure the motion is that it was made ready by.
    """
    for _ in range(ROUNDS):
        T_map_scan, twist, rms = local_map.surface.planes.fit_moving(scan, fit.T_map_scan, slope, information)
        ends = displacement(exp(twist), np.eye(4), scan.points)
        if not ends > LEFT * max(rms, LEAST_SIGMA):
            break
        settled = ends < SETTLED
        better = moving.with_rest(twist) if settled else moving.with_twist(twist)
        again = scan.deskewed(twist) if settled else better.prepared()
        if again is None:
            break
        found = local_map.fit(again, T_map_scan, (COARSE, FINE), fit.start, few=True)
        if found.total > fit.total:
            break
        scan, moving, fit = again, better, found
        if settled:
            break
    return scan, moving
