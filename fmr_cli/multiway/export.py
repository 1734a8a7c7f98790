"""What a network leaves behind: scans.csv, links.csv, poses/, links/, network.json, network.g2o, and moved clouds."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fmr_cli.batch.one_pair import suffix_for
from fmr_cli.cloud import PointCloud
from fmr_cli.geometry.frames import Frame
from fmr_cli.geometry.se3 import adjoint
from fmr_cli.geometry.voxels import voxel_keys
from fmr_cli.io import atomic_write, read_cloud, write_cloud, write_transform
from fmr_cli.io.outputs import cell, write_json
from fmr_cli.io.stream import collect
from fmr_cli.multiway.links import Link
from fmr_cli.multiway.network import Network
from fmr_cli.registration.export import merged_clouds

SCANS = ("scan", "component", "pose", "status", "links", "residual", "sigma_rot_deg", "sigma_shift", "message")
LINKS = (
    "source", "target", "status", "confidence", "overlap", "inlier_rmse", "transform", "residual_rot_deg",
    "residual_shift", "message",
)  # fmt: skip


def write_network(network: Network, out: Path) -> None:
    """Everything but clouds, to the folder ``out``, which is there. Raises CloudFileError."""
    for folder in ("poses", "links"):
        (out / folder).mkdir(exist_ok=True)
    scans = []
    for scan in network.scans:
        path = f"poses/{scan.name}.txt" if scan.T_component_scan is not None else ""
        if scan.T_component_scan is not None:
            write_transform(out / path, scan.T_component_scan)
        scans.append({
            "scan": scan.name, "component": "" if scan.component is None else scan.component, "pose": path,
            "status": scan.status, "links": scan.links, "residual": number(scan.residual),
            "sigma_rot_deg": number(scan.sigma_rot_deg), "sigma_shift": number(scan.sigma_shift),
            "message": scan.message,
        })  # fmt: skip
    links = []
    for link in network.links:
        source, target = network.scans[link.source].name, network.scans[link.target].name
        path = f"links/{source}--{target}.txt" if link.hypotheses else ""
        if path:
            write_transform(out / path, network.pose(link))
        links.append({
            "source": source, "target": target, "status": link.status, "confidence": number(link.confidence),
            "overlap": number(link.overlap), "inlier_rmse": number(link.inlier_rmse), "transform": path,
            "residual_rot_deg": number(link.residual_rot_deg), "residual_shift": number(link.residual_shift),
            "message": link.message,
        })  # fmt: skip
    write_table(out / "scans.csv", SCANS, scans)
    write_table(out / "links.csv", LINKS, links)
    write_json(out / "network.json", network.to_dict())
    with atomic_write(out / "network.g2o") as temporary:
        temporary.write_text("".join(f"{line}\n" for line in g2o(network)), "ascii")


def number(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""


def write_table(path: Path, columns: Sequence[str], rows: list[dict[str, Any]]) -> None:
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows({name: cell(value) for name, value in row.items()} for row in rows)


def g2o(network: Network) -> Iterator[str]:
    """The pose graph as g2o's lines; a vertex's number is the scan's row in scans.csv.

    An edge's information is that of (shift, rotation vector) in the second scan's axes, as GTSAM and Ceres read it.
    """
    for n, scan in enumerate(network.scans):
        if scan.T_component_scan is not None:
            yield f"VERTEX_SE3:QUAT {n} {pose_words(scan.T_component_scan)}"
    order = [3, 4, 5, 0, 1, 2]
    for link in network.links:
        if link.chosen is None:
            continue
        T = network.pose(link)
        J = adjoint(inverse_shift(network.frames[link.target]) @ T)
        information = (J.T @ link.information @ J)[np.ix_(order, order)]
        upper = " ".join(f"{x:.17g}" for x in information[np.triu_indices(6)])
        yield f"EDGE_SE3:QUAT {link.target} {link.source} {pose_words(T)} {upper}"


def inverse_shift(frame: Frame) -> np.ndarray:
    """File's coordinates to centred ones, as 4x4."""
    C = np.eye(4)
    C[:3, 3] = -frame.origin
    return C


def pose_words(T: np.ndarray) -> str:
    return " ".join(f"{x:.17g}" for x in [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])


def write_aligned(network: Network, out: Path) -> list[str]:
    """Each placed scan in its component's frame, in its own format, to ``out``/aligned; returns warnings."""
    (out / "aligned").mkdir(exist_ok=True)
    warnings = []
    for members in network.components:
        crs = crs_of(network, members)
        for n in members:
            cloud = moved(network, n, crs)
            warnings += write_cloud(
                out / "aligned" / f"{network.scans[n].name}{suffix_for(cloud.path) if cloud.path else '.ply'}", cloud
            )
    return list(dict.fromkeys(warnings))


def write_merged(network: Network, path: Path, voxel: float | None) -> list[str]:
    """All placed scans with ``scan_id`` (the row in scans.csv), a file a component; ``voxel``: one point a cell of it.

    Where there are several components, their numbers go before the suffix. Returns warnings.
    """
    warnings = []
    for number, members in enumerate(network.components):
        crs = crs_of(network, members)
        clouds = [thinned(moved(network, n, crs), voxel) for n in members]
        merged, said = merged_clouds(clouds, "scan_id", members)
        name = path if len(network.components) == 1 else path.with_name(f"{path.stem}_{number}{path.suffix}")
        warnings += said + write_cloud(name, thinned(collect(merged), voxel) if voxel else merged)
    return list(dict.fromkeys(warnings))


def moved(network: Network, n: int, crs: str | None) -> PointCloud:
    """A scan as its file has it, in its component's frame."""
    source, T = network.sources[n].source, network.scans[n].T_component_scan
    assert T is not None
    cloud = (source if isinstance(source, PointCloud) else read_cloud(source)).transformed(T)
    cloud.crs = crs
    return cloud


def crs_of(network: Network, members: list[int]) -> str | None:
    """The CRS of the scan whose frame is the component's; of fixed scans the first that has one."""
    anchor = network.anchors[network.scans[members[0]].component or 0]
    named = [n for n in members if network.scans[n].name == anchor] if anchor else members
    for n in named:
        source = network.sources[n].source
        crs = (source if isinstance(source, PointCloud) else read_cloud(source)).crs
        if crs:
            return crs
    return None


def thinned(cloud: PointCloud, voxel: float | None) -> PointCloud:
    """The first point of each voxel, or the cloud as it is."""
    if voxel is None:
        return cloud
    return cloud.select(np.sort(np.unique(voxel_keys(cloud.points, voxel), return_index=True)[1]))


def summary(network: Network) -> list[str]:
    """A few lines for a person."""
    status = {
        s: sum(link.status == s for link in network.links) for s in ("aligned", "uncertain", "failed", "rejected")
    }
    said = ", ".join(f"{count} {name}" for name, count in status.items() if count or name == "aligned")
    placed = sum(scan.component is not None for scan in network.scans)
    sizes = ", ".join(str(len(members)) for members in network.components) or "none"
    lines = [
        f"{placed} of {len(network.scans)} scans placed; components of {sizes} scans; {len(network.links)} pairs "
        f"registered: {said}"
    ]
    lines += [f"{s.name} failed: {s.message}" for s in network.scans if s.status == "failed"]
    lines += [f"{link_name(network, x)} is rejected: {x.message}" for x in network.links if x.status == "rejected"]
    for apart in network.apart[:5]:
        lines.append(
            f"{apart.source} to {apart.target} would join two components, but: {apart.reason}; if you know that link, "
            f"give it with --links"
        )
    lone = [s.name for s in network.scans if s.status == "unplaced"]
    if lone:
        lines.append(f"not placed: {', '.join(lone[:20])}{f' and {len(lone) - 20} more' if len(lone) > 20 else ''}")
    return lines


def link_name(network: Network, link: Link) -> str:
    return f"{network.scans[link.source].name} to {network.scans[link.target].name}"
