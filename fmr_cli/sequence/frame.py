"""What the odometry says of one scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmr_cli.sequence.moving_scan import MovingScan


@dataclass(frozen=True)
class Frame:
    """What came of one scan.

    T_first_scan: (4, 4) float64, file units. status: "aligned", or "uncertain": the pose is then the prediction, and
    the scan is kept out of the map; or it has leapt to where nothing but its own fit speaks for it. overlap: share of
    its points with a counterpart on the map. inlier_rmse: their root mean square distance from the map's local planes,
    file units. start: where the accepted pose came from ("first", "prediction", "zero-motion", "features").
    feature_errors: see ``feature_error``, by the last usable scan. moving: the scan with the motion within it by which
    it was registered, where it was deskewed. unobserved: directions along which the scan does not tell its pose, in the
    first scan's axes ("shift along (1.00, 0.00, 0.00)"); there the pose is the prediction, and the frame "uncertain"
    once sigma_shift (file units) or sigma_rotation (degrees), the pose's standard deviations along the worst direction,
    could matter.
    """

    T_first_scan: np.ndarray
    status: str
    overlap: float
    inlier_rmse: float
    start: str
    feature_errors: tuple[float, float] | None = None
    unobserved: tuple[str, ...] = ()
    sigma_shift: float = 0.0
    sigma_rotation: float = 0.0
    moving: MovingScan | None = None
