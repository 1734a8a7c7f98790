"""The report of ``fmr multiway``: a network of scans, its links, and what to do about the doubtful ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.multiway.links import Link
from fmr_cli.multiway.network import Network, Placed
from fmr_cli.registration.result import versions
from fmr_cli.report import networks
from fmr_cli.report.networks import Node, column
from fmr_cli.report.page import write_page

SCANS = (
    column("status", "Status", "status"), column("scan", "Scan", "name"), column("component", "Component"),
    column("links", "Links"),
    column("residual", "Plane error", hint="root mean square distance to the planes of the scans it overlaps"),
    column("sigma_rot_deg", "Sigma, rotation °", hint="standard deviation against the anchor, worst direction"),
    column("sigma_shift", "Sigma, shift", hint="standard deviation against the anchor, worst direction"),
    column("message", "Message", "words"),
)  # fmt: skip
LINKS = (
    column("picture", "Picture", "picture"), column("status", "Status", "status"), column("source", "Source", "name"),
    column("target", "Target", "name"), column("confidence", "Confidence"), column("overlap", "Overlap", "share"),
    column("inlier_rmse", "Surface error (RMSE)"),
    column("residual_rot_deg", "Off the network, °", hint="rotation between the link and the network's poses"),
    column("residual_shift", "Off the network, shift", hint="shift between the link and the network's poses"),
    column("strength", "Strength x y z", "short", "how firmly a shift along each axis is held, of the strongest"),
    column("message", "Message", "words"),
)  # fmt: skip
WHAT = {
    "rejected": "Look at its picture. If it is right, give it with --links as known, and look at the links that "
    "contradict it; if it is wrong, nothing is to be done.",
    "uncertain": "Not used. If the picture is right, give the pair with --links as known; a scan taken between the two "
    "gives surer links.",
    "used": "Uncertain by itself, but the other links confirm it: it is used.",
    "failed": "Check the two files with fmr info.",
}


def write_multiway(path: Path, network: Network, words: Sequence[str] = ()) -> None:
    """The report of a network as one HTML file. words: what the command says at its end."""
    nodes = [node(scan, network, number) for number, scan in enumerate(network.scans)]
    by_name = {n.name: n for n in nodes}
    links = [link_row(link, network, number) for number, link in enumerate(network.links)]
    poses = {link["id"]: network.pose(k) for link, k in zip(links, network.links, strict=True) if k.hypotheses}

    def seen(link: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        if link["id"] not in poses:
            return None
        return by_name[link["source"]].points, by_name[link["target"]].points, poses[link["id"]]

    networks.with_pictures(links, seen)
    count = Counter(link["status"] for link in links)
    placed = sum(scan.component is not None for scan in network.scans)
    to_do, more = networks.doubtful(links)
    whole = "all scans in one frame" if network.whole else "not all scans are in one frame"
    write_page(
        path, "network.html", networks.network_data(nodes, links), ("clouds.js", "network.js"),
        title=f"Network of {len(nodes)} scans", status="aligned" if network.whole else "uncertain",
        words=[whole, *words], figures=[
            (f"{placed} of {len(nodes)}", "scans placed"), (str(len(network.components)), "components"),
            *((str(count[status]), f"links {status}") for status in reversed(networks.STATUSES)),
        ],
        links=links, link_columns=LINKS, link_statuses=[s for s in networks.STATUSES if count[s]],
        scans=[scan_row(scan) for scan in network.scans], scan_columns=SCANS,
        scan_statuses=sorted({scan.status for scan in network.scans}), doubtful=to_do, more_doubtful=more,
        components=[component_name(n, anchor) for n, anchor in enumerate(network.anchors)],
        settings={name: value for name, value in network.settings.items() if name != "scans"},
        seconds=network.seconds, versions=versions(),
    )  # fmt: skip


def node(scan: Placed, network: Network, number: int) -> Node:
    sources = network.sources
    points = networks.points_of(sources[number].source) if number < len(sources) else np.zeros((0, 3))
    words = f"{scan.name}: {scan.status}, {scan.links} links"
    return Node(scan.name, scan.status, words, scan.component, scan.T_component_scan, points)


def component_name(number: int, anchor: str | None) -> str:
    return f"{number}, in the frame of {anchor}" if anchor else f"{number}, by the fixed scans"


def scan_row(scan: Placed) -> dict[str, Any]:
    return {
        "id": "", "status": scan.status, "scan": scan.name, "component": scan.component, "links": scan.links,
        "residual": networks.number_of(scan.residual), "sigma_rot_deg": networks.number_of(scan.sigma_rot_deg),
        "sigma_shift": networks.number_of(scan.sigma_shift), "message": scan.message,
    }  # fmt: skip


def link_row(link: Link, network: Network, number: int) -> dict[str, Any]:
    used = link.chosen is not None and link.status == "uncertain"
    firm = np.sqrt(np.maximum(np.diag(link.information)[3:], 0))
    share = 100 * firm / firm.max() if firm.max() > 0 else None
    return {
        "id": f"link-{number}", "status": link.status, "source": network.scans[link.source].name,
        "target": network.scans[link.target].name, "confidence": float(link.confidence),
        "overlap": float(link.overlap), "inlier_rmse": networks.number_of(link.inlier_rmse or None),
        "residual_rot_deg": networks.number_of(link.residual_rot_deg),
        "residual_shift": networks.number_of(link.residual_shift), "message": link.message,
        "strength": " ".join(f"{x:.0f}" for x in share) + " %" if share is not None else "\u2013",
        "what": WHAT["used" if used else link.status] if link.status in WHAT else "",
    }  # fmt: skip
