"""Figures of others on the field's benchmarks, as they published them: quoted, never measured here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Quoted:
    """recall: percent; rre: degrees; rte: the scans' unit; None where the source, which is named, has none."""

    dataset: str
    method: str
    recall: float | None
    rre: float | None
    rte: float | None
    source: str


GEO = "README of github.com/qinzheng93/GeoTransformer at e7a135a"
SC2 = "README of github.com/ZhiChen902/SC2-PCR at 19961ea; right there: 15 deg, 0.3 m"
SC2_KITTI = "README of github.com/ZhiChen902/SC2-PCR at 19961ea"
EGS = "latex_tables/ETH_results.tex of github.com/DavidBoja/exhaustive-grid-search at ed75a55"
PREDATOR = "abstract of arXiv:2011.13005"

QUOTED = (
    Quoted("3DMatch", "Predator", 90.6, None, None, PREDATOR),
    Quoted("3DMatch", "GeoTransformer", 92.5, None, None, GEO),
    Quoted("3DMatch", "FPFH + SC2-PCR", 83.98, 2.18, 0.0656, SC2),
    Quoted("3DMatch", "FCGF + SC2-PCR", 93.28, 2.08, 0.0655, SC2),
    Quoted("3DLoMatch", "GeoTransformer", 74.2, None, None, GEO),
    Quoted("3DLoMatch", "FCGF + SC2-PCR", 57.83, 3.77, 0.1046, SC2),
    Quoted("3DLoMatch", "Predator + SC2-PCR", 69.46, 3.46, 0.0958, SC2),
    Quoted("KITTI", "GeoTransformer", 99.8, 0.230, 0.062, GEO),
    Quoted("KITTI", "FPFH + SC2-PCR", 99.64, 0.32, 0.0723, SC2_KITTI),
    Quoted("KITTI", "FCGF + SC2-PCR", 98.20, 0.33, 0.2095, SC2_KITTI),
    Quoted("ETH", "FPFH + RANSAC, 8 million", 66.34, 1.09, 0.0648, EGS),
    Quoted("ETH", "FPFH + SC2-PCR", 85.41, 0.91, 0.0608, EGS),
    Quoted("ETH", "FCGF + SC2-PCR", 92.85, 0.81, 0.0405, EGS),
    Quoted("ETH", "SpinNet", 73.07, 1.20, 0.0535, EGS),
    Quoted("ETH", "GeoTransformer", 4.91, 0.69, 0.2108, EGS),
    Quoted("ETH", "exhaustive grid search", 94.25, 0.42, 0.0183, EGS),
    Quoted("ModelNet40", "GeoTransformer, seen and partial (its own split)", None, 1.577, 0.018, GEO),
)


def quoted(dataset: str) -> list[Quoted]:
    """What is quoted of a data set by its name in papers."""
    return [row for row in QUOTED if row.dataset == dataset]
