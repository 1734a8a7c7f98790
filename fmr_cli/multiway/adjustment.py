"""From components to the network: adjusted poses, links that the others contradict, sigmas, a word on everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmr_cli.cloud import angle_degrees
from fmr_cli.geometry.frames import leave_frames
from fmr_cli.multiway import claims, joint, looks, pose_graph
from fmr_cli.multiway.components import Component, Join, homes
from fmr_cli.multiway.links import Link
from fmr_cli.multiway.network import Apart, Network, Placed
from fmr_cli.multiway.pose_graph import Factor, Prior, Solution
from fmr_cli.multiway.survey import Survey, nearest_pairs

DOUBTFUL = 1.5  # voxel edges that a link may differ from what all others say, ...
OUTLYING = 5.0  # ... or so many times what links differ by in the median
TESTS = 10  # rounds of throwing out links, at most


def adjust(survey: Survey) -> Network:
    """The network of a survey whose pairs are registered."""
    scans = [
        Placed(scan.name, str(scan.path or scan.name), "failed" if n in survey.failed else "unplaced",
               message=survey.messages.get(n, ""))
        for n, scan in enumerate(survey.scans)
    ]  # fmt: skip
    anchors: list[str | None] = []
    for component in survey.components:
        if len(component.T_component_scan) < 2 and not component.held:
            continue
        with survey.stage("adjust"):
            solution, anchor = adjusted(survey, component)
        with survey.stage("joint refinement"):
            refined = refine(survey, component, solution, anchor)
        world = survey.world() if component.held else survey.frames[anchor]
        to_world = np.eye(4) if component.held else np.linalg.inv(refined.T_component_scan[anchor])
        given = {anchor: np.eye(4)} if not component.held else survey.fixed_poses()
        for n in sorted(component.T_component_scan):
            found = [to_world @ poses.T_component_scan[n] for poses in (solution, refined)]
            graph, T = (given.get(n, leave_frames(pose, survey.frames[n], world)) for pose in found)
            scans[n].status, scans[n].component = "placed", len(anchors)
            scans[n].T_component_scan, scans[n].T_component_scan_graph = T, graph
            component.T_component_scan[n] = refined.T_component_scan[n]
            scans[n].covariance = refined.covariance[n]
            scans[n].residual = refined.residual[n]
            scans[n].links = sum(n in link.ends and link.chosen is not None for link in survey.links.values())
        anchors.append(None if component.held else survey.scans[anchor].name)
    telling = claims.telling(survey.links.values())
    links = [judged(survey, survey.links[ends], telling) for ends in sorted(survey.links, key=lambda e: (e[1], e[0]))]
    counts = {"scans": len(scans), "looked_at": len(survey.looks), "registered": len(survey.tried)}
    return Network(
        scans, links, anchors, apart(survey), survey.frames, counts, survey.seconds, survey.settings(), survey.scans
    )


def adjusted(survey: Survey, component: Component) -> tuple[Solution, int]:
    """The pose graph of one component without the links that the others contradict; and the scan that anchors it."""
    used = agreeing(survey, component)
    edge = float(np.median([survey.edges[n] for n in component.T_component_scan]))
    priors = [p for p in survey.priors() if p.scan in component.T_component_scan]
    poses = component.T_component_scan
    if priors and not component.held:  # into the frame of the known poses
        D = mean_pose([p.T_component_scan @ np.linalg.inv(poses[p.scan]) for p in priors])
        poses = {n: D @ T for n, T in poses.items()}
    anchor = anchor_of(survey, component, used)
    held = component.held or (set() if priors else {anchor})
    motion = survey.motion(anchor, anchor)
    out: list[Link] = []
    for turn in range(TESTS):
        factors = [factor_of(survey, link) for link in used]
        solution = pose_graph.optimise(poses, factors, priors, held, motion, edge)
        poses = solution.T_component_scan
        off = np.array([contradiction(survey, link, T) for T, link in zip(solution.apart, used, strict=True)])
        told = np.isfinite(off)
        limit = max(DOUBTFUL, OUTLYING * float(np.median(off[told]))) if told.any() else np.inf
        worst = [k for k in np.argsort(-np.nan_to_num(off)) if told[k] and off[k] > limit][: max(1, len(used) // 20)]
        worst = [k for k in worst if still_joined(component, [x for m, x in enumerate(used) if m != k])]
        # A right link may have gone out while a wrong one still bent the network.
        back = [x for x in out if not worst and contradiction(survey, x, between(poses, x)) <= DOUBTFUL]
        if turn == TESTS - 1 or not (worst or back):
            break
        returned = {x.ends for x in back}
        out = [x for x in out if x.ends not in returned] + [used[k] for k in worst]
        used = [link for k, link in enumerate(used) if k not in set(worst)] + back
    for link in out:
        if link.status == "aligned":
            link.status = "rejected"
            elsewhere = contradiction(survey, link, between(poses, link)) * link.edge
            link.message = said(link, f"the other links have it {elsewhere:.3g} elsewhere")
        link.chosen = None
    component.T_component_scan.update(poses)
    return solution, anchor


def agreeing(survey: Survey, component: Component) -> list[Link]:
    """The links within a component, each with the hypothesis that agrees with its poses; those without are rejected."""
    used = []
    poses = component.T_component_scan
    telling = claims.telling(survey.links.values())
    for link in survey.links.values():
        if link.source not in poses or link.target not in poses or not link.hypotheses:
            continue
        agreed = claims.agreeing(link, poses, survey.moment(link.source), link.source in telling)
        both_held = link.source in component.held and link.target in component.held
        if agreed and not both_held:
            link.chosen = min(agreed, key=lambda k: agreed[k])
            used.append(link)
            if link.chosen > 0 and link.status == "aligned":
                link.message = said(link, "the network has chosen another of its poses")
        elif link.status == "aligned" and not agreed:
            link.status = "rejected"
            what = "the poses of the fixed scans" if both_held else "other links"
            off = contradiction(survey, link, between(poses, link))
            if off > claims.AGREE * claims.lenient(len(poses)):
                link.message = said(link, f"contradicts {what}: {off * link.edge:.3g} apart")
    return used


def between(T_component_scan: dict[int, np.ndarray], link: Link) -> np.ndarray:
    """T_target_source of a link's scans at a component's poses."""
    return np.linalg.inv(T_component_scan[link.target]) @ T_component_scan[link.source]


def contradiction(survey: Survey, link: Link, T_target_source: np.ndarray | None) -> float:
    """How far a link lies from where the others have it (4, 4), in edges; NaN where they don't say."""
    if T_target_source is None:
        return float("nan")
    off = looks.displacement(T_target_source, link.T_target_source, survey.moment(link.source))
    return float(off) / link.edge


def said(link: Link, text: str) -> str:
    return "; ".join(filter(None, [link.message, text]))


def factor_of(survey: Survey, link: Link) -> Factor:
    information = pose_graph.bounded(link.information, survey.radius(link.target), link.edge)
    return Factor(link.source, link.target, link.T_target_source, information)


def anchor_of(survey: Survey, component: Component, used: list[Link]) -> int:
    """The scan that is asked for, else the one with most links, the first of equals."""
    if survey.anchor in component.T_component_scan:
        return survey.anchor
    count = {n: sum(n in link.ends for link in used) for n in sorted(component.T_component_scan)}
    return max(count, key=lambda n: (count[n], -n))


def still_joined(component: Component, links: list[Link]) -> bool:
    """Whether links join all scans of a component; scans that don't move are one."""
    return len(set(homes(component, [link.ends for link in links]).values())) == 1


def mean_pose(poses: list[np.ndarray]) -> np.ndarray:
    """The chordal mean of rotations, the median of shifts."""
    T = np.eye(4)
    U, _, Vt = np.linalg.svd(sum(D[:3, :3] for D in poses))
    T[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = np.median([D[:3, 3] for D in poses], axis=0)
    return T


def refine(survey: Survey, component: Component, solution: Solution, anchor: int) -> joint.Refined:
    """All scans of a component at once, from the graph's poses."""
    poses, held = solution.T_component_scan, component.held or {anchor}
    rejected = {x.ends for x in survey.links.values() if x.status == "rejected"}

    def shared(i: int, j: int) -> float:
        return survey.overlap(i, j, np.linalg.inv(poses[j]) @ poses[i])

    pairs = joint.partners(nearest_pairs(poses, 3 * joint.PARTNERS), shared, rejected)
    numbers = sorted(poses)
    made = survey.each("refining", lambda n: joint.view(survey.store.prepared(n), survey.edges[n]), numbers)
    views = dict(zip(numbers, made, strict=True))
    priors: list[Prior] = [p for p in survey.priors() if p.scan in poses]
    motion = survey.motion(anchor, anchor)
    return joint.refine(poses, views, pairs, held, motion, survey.workers, priors)


def judged(survey: Survey, link: Link, telling: set[int]) -> Link:
    """The link with its residuals against the network, if both its scans are in one component.

    telling: the scans whose views tell right poses from wrong ones.
    """
    home = {n: k for k, c in enumerate(survey.components) for n in c.T_component_scan}
    if link.source in home and home[link.source] == home.get(link.target) and link.hypotheses:
        poses = survey.components[home[link.source]].T_component_scan
        network = between(poses, link)
        D = np.linalg.inv(network) @ link.T_target_source
        link.residual_rot_deg, link.residual_shift = (
            angle_degrees(D),
            float(np.linalg.norm(link.T_target_source[:3, 3] - network[:3, 3])),
        )
    elif link.status == "aligned":
        link = replace(link, status="rejected", message=said(link, "too much speaks against joining its components"))
    h = link.hypotheses[0] if link.hypotheses else None
    if link.status == "rejected" and h and claims.contradicted(h, link.source in telling):
        link.message = said(link, str(h.seen))
    return link


def apart(survey: Survey) -> list[Apart]:
    """The best join of each component to another one, and what speaks against it."""
    found = []
    for (first, second), join in sorted(survey.joins.items(), key=lambda x: -x[1].probability):
        link = list(survey.links.values())[join.links[0]]
        found.append(Apart(first, second, survey.scans[link.source].name, survey.scans[link.target].name,
                           join.probability, why_not(link, join)))  # fmt: skip
    return found


def why_not(link: Link, join: Join) -> str:
    """What speaks against a join, for a person."""
    reasons = [f"confidence {link.confidence:.2f}"]
    if len(join.links) > 1 and not join.sound:
        reasons.append(f"none of {len(join.links)} links that agree is sure by itself")
    if join.against > 0.05:
        reasons.append(f"another pose fits about as well ({join.against:.2f})")
    if join.denied:
        reasons.append(f"{join.denied} pairs that would overlap don't fit there")
    return ", ".join(reasons)
