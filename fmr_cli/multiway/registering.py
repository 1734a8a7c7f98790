"""Pairs are registered, or recalled from the journal; what they say is judged by the scans' views, and joined."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fmr_cli.errors import FmrError, ModelError
from fmr_cli.geometry.frames import enter_frames, leave_frames
from fmr_cli.geometry.se3 import adjoint
from fmr_cli.io.files import reason
from fmr_cli.multiway import claims, consistency
from fmr_cli.multiway.components import Component
from fmr_cli.multiway.links import Hypothesis, Link, best_of, key_of
from fmr_cli.multiway.looks import best_of as best_look
from fmr_cli.multiway.scans import Scan
from fmr_cli.multiway.store import Store
from fmr_cli.multiway.survey import Survey, ends_of
from fmr_cli.multiway.visibility import Seen
from fmr_cli.registration import Options, align
from fmr_cli.workers.base import LostError, check_there, kept

BELOW_GIVEN = 1 - 1e-9  # confidence of a pose that is found: 1 is for one that is given


@dataclass(frozen=True)
class Attempt:
    """A pair to register: source and target by number, the kind of start, the options of ``align``. Picklable."""

    source: int
    target: int
    start: str
    options: Options

    @property
    def key(self) -> str:
        """Its name in the journal."""
        return key_of(self.source, self.target, self.start, self.options)


def attempt(survey: Survey, source: int, target: int, start: str, T: np.ndarray | None = None) -> Attempt:
    """A pair to register; T: T_target_source between centred frames to start from, or None for ``align``'s own starts.

    ``max_shift`` bounds how far scans move in the network (``Survey.allowed``), not here.
    """
    init: Any = start if T is None else leave_frames(T, survey.frames[source], survey.frames[target])
    return Attempt(source, target, start, replace(survey.options, init=init, max_shift=None))


def from_look(survey: Survey, source: int, target: int) -> Attempt:
    """A pair to register from the best pose of its look that is left: cheap where it is right, and where it is not."""
    return attempt(survey, source, target, "look", survey.looks[source, target].T_target_source)


def register(store: Store, task: Attempt) -> Link:
    """One pair through ``align``; whatever it runs into becomes a failed link. Raises ModelError alone."""
    source, target, start = task.source, task.target, task.start
    try:
        a, b = store.prepared(source), store.prepared(target)
        found = align(a, b, task.options, threads=1, hints=False)
        poses = [(found.T_target_source, found.confidence)]
        poses += [(np.array(x["T_target_source"]), x["confidence"]) for x in found.alternatives]
        sure, firm = found.status == "aligned", not found.undetermined
        hypotheses = [
            Hypothesis(enter_frames(T, a.frame, b.frame), min(float(c), BELOW_GIVEN), sure and n == 0, firm and n == 0)
            for n, (T, c) in enumerate(poses)
        ]
        return Link(
            source, target, found.status, start, hypotheses,
            found.information, found.overlap, found.inlier_rmse, found.voxel_size, "; ".join(found.undetermined),
        )  # fmt: skip
    except ModelError:
        raise
    except FmrError as error:
        return Link(source, target, "failed", start, message=" ".join(str(error).split()))
    except Exception as error:  # whatever one pair runs into, the others go on
        return Link(source, target, "failed", start, message=f"{type(error).__name__}: {reason(error)}")


@dataclass(frozen=True)
class Errand:
    """An attempt with all that a worker in another process needs to know.

    run: a name for what such a worker keeps for the run. scans, edges: of the two scans, by number. there: files that
    the worker has to see.
    """

    run: str
    seed: int
    scans: dict[int, Scan]
    edges: dict[int, float]
    there: tuple[Path, ...]
    attempt: Attempt


def errand(survey: Survey, task: Attempt) -> Errand:
    """An attempt for a worker in another process."""
    ends = (task.source, task.target)
    scans = {n: survey.scans[n] for n in ends}
    scans = {n: replace(s, source=s.source.absolute()) if isinstance(s.source, Path) else s for n, s in scans.items()}
    there = tuple(s.source for s in scans.values() if isinstance(s.source, Path) and s.source.is_file())
    return Errand(survey.name, survey.options.seed, scans, {n: survey.edges[n] for n in ends}, there, task)


def run_errand(task: Errand) -> Link:
    """In another process: ``register``. Raises UnfitError where a file is not there."""
    check_there(task.there)
    store = kept(f"multiway {task.run}", lambda: Store({}, task.seed, None))
    store.scans.update(task.scans)
    store.edges.update(task.edges)
    return register(store, task.attempt)


def register_all(survey: Survey, attempts: list[Attempt]) -> None:
    """Registers pairs, or recalls what the journal has of them, and brings the components up to date."""
    known = {task.key: survey.journal.recall(task.key) for task in attempts}
    new = [task for task in attempts if known[task.key] is None]

    def arrived(number: int, found: Link | LostError) -> None:
        task = new[number]
        if isinstance(found, LostError):
            found = Link(task.source, task.target, "failed", task.start, message=str(found))
        known[task.key] = survey.journal.keep(task.key, found)

    with survey.stage("register"):
        if survey.workers.cluster:
            survey.each("registering", run_errand, [errand(survey, task) for task in new], arrived, handed_out=True)
        else:
            survey.each("registering", partial(register, survey.store), new, arrived)
    links = []
    for task in attempts:
        link = known[task.key]
        assert link is not None
        if link.start == "look":  # another pose of the look may be tried in a later round
            survey.looks[link.ends] = best_look(survey.looks[link.ends].others)
        survey.tried.add((*ends_of(*link.ends), link.start))
        kept = [h for h in link.hypotheses if survey.allowed(link.source, link.target, h.T_target_source)]
        if link.hypotheses and not kept:
            link = replace(link, status="uncertain", message="no pose within the known poses and --max-shift")
        links.append(flipped(replace(link, hypotheses=kept)))
    with survey.stage("see through"):
        judge_views(survey, links)
    with survey.stage("join"):
        keep(survey, links)
        join(survey)


def judge_views(survey: Survey, links: list[Link]) -> None:
    """What the scans see of each other at each hypothesis."""
    new = [(link, h) for link in links for h in link.hypotheses]
    seen = survey.each("comparing views", lambda x: survey.seen([(*x[0].ends, x[1].T_target_source)])[0], new)
    for (_, h), said in zip(new, seen, strict=True):
        h.seen = said


def keep(survey: Survey, links: list[Link]) -> None:
    """Takes links in, each beside what another attempt at its pair has given."""
    scans = claims.telling([*survey.links.values(), *links])

    def worth(link: Link) -> float:
        return max((claims.log_odds(h, link.source in scans) for h in link.hypotheses[:1]), default=-np.inf)

    for link in links:
        survey.links[link.ends] = best_of(survey.links.get(link.ends), link, worth)


def take_known_links(survey: Survey) -> None:
    """Links that are given, and those that are asked for."""
    for source, target, T in survey.given:
        if source in survey.edges and target in survey.edges:
            pose = Hypothesis(
                enter_frames(T, survey.frames[source], survey.frames[target]), 1.0, True, True, Seen(0, 0, 0)
            )
            edge = survey.pair_edge(source, target)
            sure = np.diag([1 / (edge / survey.radius(target)) ** 2] * 3 + [1 / edge**2] * 3)
            keep(survey, [flipped(Link(source, target, "aligned", "known", [pose], sure, edge=edge, message="given"))])
            survey.never.add(ends_of(source, target))
    attempts = []
    for source, target, rough in survey.asked:
        if source in survey.edges and target in survey.edges:
            start = None if rough is None else enter_frames(rough, survey.frames[source], survey.frames[target])
            attempts.append(attempt(survey, source, target, "auto" if start is None else "pose", start))
    register_all(survey, attempts)


def join(survey: Survey) -> None:
    """The components that the links so far give."""
    order = sorted(survey.edges)
    place = {n: k for k, n in enumerate(order)}
    links = [replace(x, source=place[x.source], target=place[x.target]) for x in survey.links.values()]
    moments = {place[n]: m for n, m in survey.moments().items()}
    fixed = survey.fixed()
    given = Component({place[n]: T for n, T in fixed.items()}, {place[n] for n in fixed})
    found, survey.joins = consistency.joined(
        len(order), links, moments, lambda i, j, T: survey.overlap(order[i], order[j], T), given,
        lambda pairs: survey.seen([(order[i], order[j], T) for i, j, T in pairs]),
    )  # fmt: skip
    survey.components = [
        Component({order[k]: T for k, T in c.T_component_scan.items()}, {order[k] for k in c.held}) for c in found
    ]


def flipped(link: Link) -> Link:
    """The link with its higher scan as the source."""
    if link.source > link.target:
        return link
    hypotheses = [replace(h, T_target_source=np.linalg.inv(h.T_target_source)) for h in link.hypotheses]
    A = adjoint(link.T_target_source)
    return replace(
        link, source=link.target, target=link.source, hypotheses=hypotheses, information=A.T @ link.information @ A
    )
