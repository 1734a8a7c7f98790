"""The feature-metric error of a frame: how far its global feature is from that of the scan before, F(g Q) - F(P)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.sequence.prepared_scan import PreparedScan


def feature_errors(
    last: PreparedScan, scan: PreparedScan, T_last_scan: np.ndarray, model: Path | None
) -> tuple[float, float]:
    """Mean |F(g Q) - F(P)| with the scan where the last one is, and at its pose T_last_scan (4, 4).

    In the unit box of the last scan's points, of which a few stand for all; its own feature is worked out once.
    """
    from fmr_cli.registration.models import fast_encoder

    encode, (centre, unit) = fast_encoder(model), last.box
    before, after = (
        encode(((points - centre) / unit).astype(np.float32))
        for points in (scan.few, transform_points(T_last_scan, scan.few))
    )
    feature = last.feature(encode)
    return float(np.abs(before - feature).mean()), float(np.abs(after - feature).mean())
