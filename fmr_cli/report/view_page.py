"""`fmr view --html`: the clouds as a page that needs no network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.cloud import PointCloud
from fmr_cli.report.coloring import Coloring, rgb_of, values_of
from fmr_cli.report.networks import number_of
from fmr_cli.report.page import write_page
from fmr_cli.report.points import packed, packed_shares, raw
from fmr_cli.report.view_clouds import Section, box

ON_PAGE = 120_000  # points of all clouds together


def write_view(path: Path, clouds: list[PointCloud], by: Coloring, size: float, section: Section | None) -> None:
    """The clouds as a page that needs no network."""
    low, high = box(clouds)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    each = max(ON_PAGE // len(clouds), 500)
    rng = np.random.default_rng(0)
    few = [c.select(rng.permutation(len(c))[:each]) for c in clouds]
    scales: dict[str, dict[str, Any]] = {}
    drawn: list[dict[str, Any]] = [
        {"name": c.path.name if c.path else c.name, "points": packed(c.points - middle), "values": {}} for c in few
    ]
    for name in ("height", "intensity", "residual"):
        values = [values_of(c, name) for c in few]
        known = [v for v in values if v is not None and len(v)]
        if not known:
            continue
        least, most = (float(x) for x in np.quantile(np.concatenate(known), [0.02, 0.98]))
        scales[name] = {"low": number_of(least), "high": number_of(most), "name": name, "open": True}
        for cloud, value in zip(drawn, values, strict=True):
            if value is not None:
                cloud["values"][name] = packed_shares(value - least, most - least)
    for cloud, c in zip(drawn, few, strict=True):
        rgb = rgb_of(c)
        cloud["rgb"] = None if rgb is None else raw((255 * rgb).round().astype(np.uint8))
    offers = ["file", *scales, *(["rgb"] if any(c["rgb"] for c in drawn) else [])]
    data = {"clouds": drawn, "scales": scales, "size": extent, "section": section and {
        "axis": section.axis, "at": section.at - float(middle[section.axis]), "thick": section.thick,
    }}  # fmt: skip
    write_page(
        path, "view.html", data, ("clouds.js", "view.js"), title=", ".join(str(c["name"]) for c in drawn[:4])
        + (f" and {len(drawn) - 4} more" if len(drawn) > 4 else ""), offers=offers, by=by if by in offers else "file",
        size=size, middle=middle.tolist(), files=[(c.name, c.count, len(f)) for c, f in zip(clouds, few, strict=True)],
    )  # fmt: skip
