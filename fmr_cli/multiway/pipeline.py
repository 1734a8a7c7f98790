"""The way of many scans: read and describe each, look at pairs, register the promising ones, join, refine all at once.

Rounds are fixed by what is known when they begin and end when all their pairs are done, so that nothing depends on
which worker was first.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import fmr_cli
from fmr_cli.cloud import PointCloud
from fmr_cli.cores import usable_cores
from fmr_cli.errors import CloudFileError, FmrError
from fmr_cli.geometry.frames import Frame, enter_frames, leave_frames
from fmr_cli.geometry.motion import Motion
from fmr_cli.io.files import check_writable, reason
from fmr_cli.multiway import adjustment, consistency, looks, pose_graph, visibility
from fmr_cli.multiway.consistency import Component
from fmr_cli.multiway.known import ROUGH_DEGREES, ROUGH_SHARE, Known, number_of
from fmr_cli.multiway.links import Hypothesis, Journal, Link, best_of, key_of, register
from fmr_cli.multiway.network import Network
from fmr_cli.multiway.pose_graph import Prior
from fmr_cli.multiway.scans import Scan, list_scans
from fmr_cli.multiway.store import Store
from fmr_cli.registration import Options
from fmr_cli.registration.models import local_encoder
from fmr_cli.registration.result import plain

FEW_PAIRS = 1_200  # of which every one is looked at: all of 49 scans
NEIGHBOURS = 16  # that most resemble a scan as places, looked at where there are more pairs than that
PROMISING = 0.15  # a look's promise from which a pair is worth registering: pairs without overlap hardly reach it
ROUGHLY_ONE_PLACE, ROUGHLY_CONTRADICTED = 0.006, 0.012  # as visibility.ONE_PLACE, CONTRADICTED, at a look's rough pose
FIRST, NEXT = 3, 3  # promising pairs of a scan that are registered in the first round, of a component in each later one
ROUNDS = 12  # of joining components, at most
CONFIRMED = 3  # links of a scan that stop the search for more
SHARED = 0.3  # overlap at the network's poses from which an untried pair is worth registering
ROUND_TRIP = 4  # links between two scans that overlap, from which one between them is worth it whatever they have
DEAR, DEAR_SHARE = 2, 0.5  # pairs of a component that the dear starts are tried on; of all scans, at most


@dataclass(frozen=True)
class Progress:
    """What is going on: stage, how much of it is done, and the network so far."""

    stage: str
    done: int
    total: int
    aligned: int = 0
    components: int = 0


@dataclass(frozen=True)
class Attempt:
    """A pair to register: source and target by number, the kind of start, the options of ``align``."""

    source: int
    target: int
    start: str
    options: Options


def align_many(
    scans: Iterable[str | Path | PointCloud],
    options: Options = Options(),
    *,
    known: Known = Known(),
    out: Path | None = None,
    resume: bool = False,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Network:
    """Finds a pose for each of many scans, in any order, and says which links between them hold.

    scans: files, folders, text files that list scans, or clouds in memory; one unit. options: how pairs are registered;
    ``max_shift``: how far a scan's centre may move against another one, from its file's or its known pose. out: folder
    of the journal, so that a killed run can go on with ``resume``; None keeps nothing on disk. workers: pairs at a
    time (default: the cores); the result does not depend on it.

    Raises FmrError where there are fewer than two scans, a name is unknown, or GTSAM is missing; a scan that cannot be
    read, or a pair that cannot be registered, is a row that says so.
    """
    pose_graph.check_installed("fmr multiway")
    survey = Survey(list_scans(scans, out), options, known, out, workers or usable_cores(), progress)
    with survey.at_work(resume):
        survey.prepare()
        survey.take_known_links()
        survey.look_at_pairs()
        survey.register_most_promising()
        survey.join_components()
        survey.confirm()
        if survey.try_dear_starts():
            survey.join_components()
            survey.confirm()
        return survey.network()


class Survey:
    """The state of one run; its methods are the steps of ``align_many``, in order."""

    def __init__(
        self,
        scans: list[Scan],
        options: Options,
        known: Known,
        out: Path | None,
        workers: int,
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self.scans, self.options, self.known, self.out = scans, options, known, out
        self.workers, self.report = workers, progress or (lambda _: None)
        self.local = local_encoder(options.model)
        self.seconds: dict[str, float] = {}
        self.messages: dict[int, str] = {}  # what is wrong or odd about a scan
        self.failed: set[int] = set()
        self.edges: dict[int, float] = {}
        self.described: dict[tuple[int, float], looks.Description] = {}
        self.views: dict[int, visibility.Viewed] = {}
        self.judged: dict[int, Hypothesis] = {}  # hypotheses whose views are compared, by identity
        self.looks: dict[tuple[int, int], looks.Look] = {}
        self.links: dict[tuple[int, int], Link] = {}
        self.tried: set[tuple[int, int, str]] = set()
        self.components: list[Component] = []
        self.joins: dict[tuple[int, int], consistency.Join] = {}
        self.frames: dict[int, Frame] = {}
        self.store = Store(scans, options.seed, None if out is None else out / "work")
        self.journal = Journal(None if out is None else out / "journal.jsonl", self.settings())
        self.fixed_numbers = [number_of(name, scans, "--fixed") for name in dict.fromkeys(known.fixed)]
        self.anchor = None if known.anchor is None else number_of(known.anchor, scans, "--anchor")
        self.poses = {number_of(name, scans, "--init-poses"): pose for name, pose in known.poses.items()}
        self.never, self.asked, self.given = set(), [], []  # type: ignore[var-annotated]
        for link in known.links:
            ends = tuple(number_of(name, scans, "--links") for name in (link.source, link.target))
            if ends[0] == ends[1]:
                raise FmrError(f"--links: {link.source} is linked to itself, give two scans")
            {"never": self.never.add, "try": self.asked.append, "known": self.given.append}[link.use](
                tuple(sorted(ends)) if link.use == "never" else (*ends, link.T_target_source)
            )

    def settings(self) -> dict[str, Any]:
        """What all attempts of one journal share."""
        files = [(s.name, str(s.path), size_of(s.path)) for s in self.scans]
        known = asdict(self.known)
        return plain({"fmr": fmr_cli.__version__, "scans": files, "options": asdict(self.options), "known": known})

    @contextmanager
    def at_work(self, resume: bool) -> Iterator[None]:
        """Opens the journal and the pool of workers; the folder of spilled scans goes once the work is done.

        Raises CloudFileError where the folder cannot be written to, holds another run, or one without ``resume``.
        """
        if self.out is not None:
            if not self.out.is_dir():
                check_writable(self.out)
                self.out.mkdir()
            found, path = (
                self.journal.read() if resume or not (self.out / "journal.jsonl").exists() else {},
                self.journal.path,
            )
            if found == {}:
                raise CloudFileError(f"{path}: is there already, add --resume to go on with it or give another --out")
            if found is None:
                self.journal.begin()
            elif found != self.journal.settings:
                raise CloudFileError(f"{path}: was made from other scans or settings, give another --out")
        pool = ThreadPoolExecutor(self.workers)
        self.pool = pool
        try:
            with threadpool_limits(1):
                yield
        finally:
            pool.shutdown(cancel_futures=True)
        if self.store.spill and self.store.spill.is_dir():
            for file in self.store.spill.iterdir():
                file.unlink()
            self.store.spill.rmdir()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def each(self, stage: str, work: Callable[[Any], Any], items: list[Any]) -> list[Any]:
        """The results of ``work`` on all items, in their order, by all workers; progress is reported as they come."""
        futures = [self.pool.submit(work, item) for item in items]
        for done, _ in enumerate(as_completed(futures), 1):
            aligned = sum(link.status == "aligned" for link in self.links.values())
            self.report(Progress(stage, done, len(items), aligned, len(self.components)))
        return [future.result() for future in futures]

    # Each scan.

    def prepare(self) -> None:
        """Reads every scan once, chooses the grids that scans of like size share, and describes each on its own."""
        with self.stage("read"):
            own = dict(
                zip(
                    range(len(self.scans)),
                    self.each("reading", self.own_edge, list(range(len(self.scans)))),
                    strict=True,
                )
            )
            self.note_twins()
        usable = sorted(self.frames)
        self.failed = set(own) - set(usable)
        if not usable:
            raise FmrError(f"none of {len(own)} scans can be used; the first: {self.messages[0]}")
        with self.stage("describe"):
            size = self.options.voxel_size
            shared = [size] * len(usable) if size else looks.shared_edges([own[n] for n in usable])
            self.edges = self.store.edges = dict(zip(usable, shared, strict=True))
            self.each("describing", lambda n: self.description(n, self.edges[n]), usable)
        median = float(np.median(shared))
        for n in usable:
            if (not looks.comparable(self.edges[n], median) and self.edges[n] / median > 30) or self.edges[
                n
            ] / median < 1 / 30:
                self.note(
                    n, f"its points lie {self.edges[n] / median:.3g} times as far apart as others': in another unit?"
                )

    def own_edge(self, number: int) -> float | None:
        """The voxel edge that suits a scan, or None (and a message) where it cannot be used."""
        try:
            ready = self.store.prepared(number)
        except FmrError as error:
            self.messages[number] = " ".join(str(error).split())
            return None
        except Exception as error:  # whatever one scan runs into, the others go on
            self.messages[number] = f"{type(error).__name__}: {reason(error)}"
            return None
        self.frames[number] = ready.frame
        return ready.edge

    def note(self, number: int, text: str) -> None:
        self.messages[number] = "; ".join(filter(None, [self.messages.get(number, ""), text]))

    def note_twins(self) -> None:
        """One file given twice stays in once; files whose points have the same mean are said to be the same scan."""
        paths: dict[Path, int] = {}
        means: dict[bytes, int] = {}
        for number in sorted(self.frames):
            source = self.scans[number].source
            path = source.resolve() if isinstance(source, Path) else None
            mean = self.frames[number].origin.tobytes()
            if path in paths:
                self.note(number, f"is the same file as {self.scans[paths[path]].name}: left out")
                del self.frames[number]
                self.store.kept.pop(number, None)
                continue
            if mean in means:
                self.note(number, f"holds the same points as {self.scans[means[mean]].name}")
            if path:
                paths[path] = number
            means.setdefault(mean, number)

    def description(self, number: int, edge: float) -> looks.Description:
        if (number, edge) not in self.described:
            self.described[number, edge] = looks.describe(self.store.prepared(number), edge, self.local)
        return self.described[number, edge]

    def moments(self) -> dict[int, np.ndarray]:
        return {n: self.description(n, edge).moment for n, edge in self.edges.items()}

    def overlap(self, source: int, target: int, T_target_source: np.ndarray) -> float:
        """The share of the smaller scan that has a counterpart at a pose; no query where they are too far apart."""
        a, b = (self.description(n, self.edges[n]) for n in (source, target))
        reach = sum(float(np.linalg.norm(d.points, axis=1).max()) for d in (a, b))
        return 0.0 if np.linalg.norm(T_target_source[:3, 3]) > reach else looks.overlap(a, b, T_target_source)

    # Each pair.

    def look_at_pairs(self) -> None:
        """A cheap look at every pair where they are few, else at those that resemble each other as places."""
        numbers = sorted(self.edges)
        pairs = [(j, i) for n, i in enumerate(numbers) for j in numbers[n + 1 :]]
        pairs = [pair for pair in pairs if self.possible(*pair)]
        with self.stage("look"):
            if len(pairs) > FEW_PAIRS:
                alike = looks.similarity([self.description(n, self.edges[n]) for n in numbers])
                place = {n: k for k, n in enumerate(numbers)}
                near: set[tuple[int, int]] = set()
                for i in numbers:
                    mine = sorted((p for p in pairs if i in p), key=lambda p: (-alike[place[p[0]], place[p[1]]], p))
                    near.update(mine[:NEIGHBOURS])
                pairs = sorted(near)
            self.looks = dict(zip(pairs, self.each("looking", self.look, pairs), strict=True))
        with self.stage("see through"):
            self.each("finding viewpoints", self.viewed, numbers)
            self.discount_what_is_seen_through()

    def discount_what_is_seen_through(self) -> None:
        """Makes looks less promising where one scan sees through the other; a look's pose is rough, so not by much.

        Nothing is changed where even each scan's best look is contradicted: such scans weren't taken from one place.
        """
        pairs = [p for p, x in self.looks.items() if x.promise >= PROMISING]

        def shares(pair: tuple[int, int]) -> list[float]:
            look = self.looks[pair]
            promising = [x for x in (look, *look.others) if x.promise >= PROMISING]
            return [self.seen_through(*pair, x.T_target_source) for x in promising]

        seen = dict(zip(pairs, self.each("comparing views", shares, pairs), strict=True))
        telling = visibility.from_one_place(((p, min(found)) for p, found in seen.items()), ROUGHLY_ONE_PLACE)
        for pair, found in seen.items():
            if pair[0] not in telling:
                continue
            look = self.looks[pair]
            factors = [1 / (1 + (share / ROUGHLY_CONTRADICTED) ** 2) for share in found]
            poses = zip((look, *look.others), factors, strict=False)
            self.looks[pair] = looks.best_of([replace(x, promise=f * x.promise, others=()) for x, f in poses])

    def look(self, pair: tuple[int, int]) -> looks.Look:
        edge = max(self.pair_edge(*pair), 1e-300)
        a, b = (self.description(n, edge) for n in pair)
        found = looks.look(a, b, self.motion(*pair, edge))
        poses = [replace(x, others=()) for x in (found, *found.others)]
        return looks.best_of([x for x in poses if self.allowed(pair[0], pair[1], x.T_target_source)])

    def viewed(self, number: int) -> visibility.Viewed:
        if number not in self.views:
            self.views[number] = visibility.view(self.store.prepared(number), self.edges[number])
        return self.views[number]

    def seen_through(self, source: int, target: int, T_target_source: np.ndarray) -> float:
        return visibility.contradiction(self.viewed(source), self.viewed(target), T_target_source)

    def pair_edge(self, source: int, target: int) -> float:
        from fmr_cli.registration.prepared import pair_edge

        return self.options.voxel_size or pair_edge(self.store.prepared(source), self.store.prepared(target))

    def motion(self, source: int, target: int, unit: float = 1.0) -> Motion:
        """What may move between two centred frames, lengths in ``unit``."""
        up = np.asarray(self.options.up, float)
        up = up / np.linalg.norm(up)
        lift = float(up @ (self.frames[source].origin - self.frames[target].origin)) / unit
        return Motion(self.options.dof, (float(up[0]), float(up[1]), float(up[2])), lift)

    def possible(self, source: int, target: int) -> bool:
        """Whether a pair can be linked at all: not forbidden, of like scale, near enough by the poses known."""
        if tuple(sorted((source, target))) in self.never or not looks.comparable(
            self.edges[source], self.edges[target]
        ):
            return False
        if source in self.poses and target in self.poses:
            T, slack = self.predicted(source, target)
            a, b = (self.description(n, self.edges[n]) for n in (source, target))
            reach = sum(float(np.linalg.norm(d.points, axis=1).max()) for d in (a, b))
            return bool(np.linalg.norm(T[:3, 3]) <= reach + slack)
        return True

    def predicted(self, source: int, target: int) -> tuple[np.ndarray, float]:
        """T_target_source between centred frames by the known poses, and how far off that may be (three sigmas)."""
        a, b = self.poses[source], self.poses[target]
        T = enter_frames(np.linalg.inv(b.T_world_scan) @ a.T_world_scan, self.frames[source], self.frames[target])
        (turn_a, shift_a), (turn_b, shift_b) = self.sigmas(source), self.sigmas(target)
        lever = float(np.linalg.norm(T[:3, 3])) + self.radius(source)
        return T, 3 * float(np.hypot(shift_a, shift_b) + np.hypot(turn_a, turn_b) * lever)

    def sigmas(self, number: int) -> tuple[float, float]:
        """Of a known pose: radians, file's unit."""
        pose = self.poses[number]
        turn = ROUGH_DEGREES if pose.sigma_rot_deg is None else pose.sigma_rot_deg
        shift = ROUGH_SHARE * self.radius(number) if pose.sigma_shift is None else pose.sigma_shift
        return float(np.radians(turn)), shift

    def allowed(self, source: int, target: int, T_target_source: np.ndarray) -> bool:
        """Whether a pose keeps to the known poses and to ``max_shift``."""
        T, frames = T_target_source, (self.frames[source], self.frames[target])
        expected = enter_frames(np.eye(4), *frames)
        if source in self.poses and target in self.poses:
            expected, slack = self.predicted(source, target)
            edge = consistency.AGREE * max(self.edges[source], self.edges[target])
            moment = self.description(source, self.edges[source]).moment
            if float(looks.displacement(T, expected, moment)) > slack + edge:
                return False
        bound = self.options.max_shift
        return bound is None or bool(np.linalg.norm(T[:3, 3] - expected[:3, 3]) <= bound)

    def attempt(self, source: int, target: int, start: str, T_target_source: np.ndarray | None = None) -> Attempt:
        """A pair to register; a given pose is between centred frames."""
        init: Any = start
        if T_target_source is not None:
            init = leave_frames(T_target_source, self.frames[source], self.frames[target])
        return Attempt(source, target, start, replace(self.options, init=init, max_shift=None))

    def from_look(self, source: int, target: int) -> Attempt:
        """A pair to register from the pose of its look: cheap where it is right, and where it is not."""
        return self.attempt(source, target, "look", self.looks[source, target].T_target_source)

    def register(self, attempts: list[Attempt]) -> None:
        """Registers pairs, or recalls what the journal has of them, and brings the components up to date."""

        def one(attempt: Attempt) -> Link:
            key = key_of(attempt.source, attempt.target, attempt.start, attempt.options)
            link = self.journal.recall(key)
            if link is None:
                link = register(self.store, attempt.source, attempt.target, attempt.start, attempt.options)
                self.journal.keep(key, link)
            return link

        with self.stage("register"):
            for link in self.each("registering", one, attempts):
                self.tried.add((*sorted(link.ends), link.start))  # type: ignore[arg-type]
                kept = [h for h in link.hypotheses if self.allowed(link.source, link.target, h.T_target_source)]
                if link.hypotheses and not kept:
                    link = replace(link, status="uncertain", message="no pose within the known poses and --max-shift")
                self.keep(replace(link, hypotheses=kept))
        with self.stage("see through"):
            new = [(link, h) for link in self.links.values() for h in link.hypotheses if id(h) not in self.judged]
            shares = self.each(
                "comparing views", lambda x: self.seen_through(x[0].source, x[0].target, x[1].T_target_source), new
            )
            for (_, h), share in zip(new, shares, strict=True):
                h.seen_through = share
                self.judged[id(h)] = h
        with self.stage("join"):
            self.join()

    def keep(self, link: Link) -> None:
        ends = (max(link.ends), min(link.ends))
        self.links[ends] = best_of(self.links.get(ends), link)

    def join(self) -> None:
        """The components that the links so far give."""
        order = sorted(self.edges)
        place = {n: k for k, n in enumerate(order)}
        links = [replace(x, source=place[x.source], target=place[x.target]) for x in self.links.values()]
        moments = {place[n]: m for n, m in self.moments().items()}
        fixed = self.fixed()
        given = Component({place[n]: T for n, T in fixed.items()}, {place[n] for n in fixed})
        found, joins = consistency.joined(
            len(order), links, moments, lambda i, j, T: self.overlap(order[i], order[j], T), given
        )  # fmt: skip
        numbers = list(self.links)
        self.joins = {k: replace(v, links=tuple(numbers.index(numbers[x]) for x in v.links)) for k, v in joins.items()}
        self.components = [
            Component({order[k]: T for k, T in c.T_component_scan.items()}, {order[k] for k in c.held}) for c in found
        ]

    def world(self) -> Frame:
        """The frame that known poses are centred by: the place of the first of them."""
        for n in [*self.fixed_numbers, *sorted(self.poses)]:
            if n in self.frames:
                pose = self.poses[n].T_world_scan if n in self.poses else np.eye(4)
                return Frame(pose[:3, :3] @ self.frames[n].origin + pose[:3, 3])
        return Frame()

    def fixed(self) -> dict[int, np.ndarray]:
        """The centred poses of the scans that don't move."""
        world = self.world()
        return {n: enter_frames(pose, self.frames[n], world) for n, pose in self.fixed_poses().items()}

    def fixed_poses(self) -> dict[int, np.ndarray]:
        """T_world_scan, files' coordinates, of the scans that don't move."""
        given = {n: self.poses[n].T_world_scan if n in self.poses else np.eye(4) for n in self.fixed_numbers}
        return {n: pose for n, pose in given.items() if n in self.edges}

    def priors(self) -> list[Prior]:
        """Known poses of scans that may move."""
        world = self.world()
        return [
            Prior(n, enter_frames(pose.T_world_scan, self.frames[n], world), *self.sigmas(n))
            for n, pose in sorted(self.poses.items())
            if n in self.edges and n not in self.fixed_numbers
        ]

    # Rounds.

    def take_known_links(self) -> None:
        """Links that are given, and those that are asked for."""
        for source, target, T in self.given:
            if source in self.edges and target in self.edges:
                pose = Hypothesis(enter_frames(T, self.frames[source], self.frames[target]), 1.0)
                edge = self.pair_edge(source, target)
                sure = np.diag([1 / (edge / self.radius(target)) ** 2] * 3 + [1 / edge**2] * 3)
                self.keep(flipped(Link(source, target, "aligned", "known", [pose], sure, edge=edge, message="given")))
                self.never.add(tuple(sorted((source, target))))
        attempts = []
        for source, target, T in self.asked:
            if source in self.edges and target in self.edges:
                T = None if T is None else enter_frames(T, self.frames[source], self.frames[target])
                attempts.append(self.attempt(source, target, "auto" if T is None else "pose", T))
        self.register([replace(a, source=a.source) for a in attempts])

    def radius(self, number: int) -> float:
        return float(np.sqrt(np.trace(self.description(number, self.edges[number]).moment[:3, :3])))

    def untried(self, start: str) -> list[tuple[int, int]]:
        """Promising pairs that have not been registered from this kind of start, best first."""
        pairs = [p for p, x in self.looks.items() if x.promise >= PROMISING and (*sorted(p), start) not in self.tried]
        pairs = [p for p in pairs if tuple(sorted(p)) not in self.never]
        return sorted(pairs, key=lambda p: (-self.looks[p].promise, p))

    def register_most_promising(self) -> None:
        """Each scan's most promising pairs, and those whose known poses say that they overlap."""
        chosen: dict[tuple[int, int], None] = {}
        pairs = self.untried("look")
        for n in sorted(self.edges):
            chosen.update(dict.fromkeys([p for p in pairs if n in p][:FIRST]))
        attempts = [self.from_look(*p) for p in sorted(chosen)]
        for n in sorted(self.poses.keys() & self.edges.keys()):
            for m in sorted(k for k in self.poses.keys() & self.edges.keys() if k < n and self.possible(n, k)):
                T, slack = self.predicted(n, m)
                if slack < 10 * self.edges[n] and (n, m) not in chosen and self.overlap(n, m, T) >= SHARED:
                    attempts.append(self.attempt(n, m, "pose", T))
        self.register(attempts)

    def join_components(self) -> None:
        """The most promising pairs that lead out of each component, until one is left or none is promising."""
        for _ in range(ROUNDS):
            chosen = self.leading_out(self.untried("look"), NEXT)
            if len(self.components) == 1 or not chosen:
                return
            self.register([self.from_look(*p) for p in chosen])

    def leading_out(self, pairs: list[tuple[int, int]], most: int) -> list[tuple[int, int]]:
        """Of pairs, best first, the first ``most`` of each component that join it to another one."""
        home = {n: k for k, c in enumerate(self.components) for n in c.T_component_scan}
        taken: dict[int, int] = {}
        chosen = []
        for p in pairs:
            ends = {home[n] for n in p}
            if len(ends) == 2 and any(taken.get(k, 0) < most for k in ends):
                chosen.append(p)
                for k in ends:
                    taken[k] = taken.get(k, 0) + 1
        return sorted(chosen)

    def confirm(self) -> None:
        """Pairs that overlap at the network's poses, for scans with few links and where they close a round trip."""
        for _ in range(2):
            attempts: dict[tuple[int, int], Attempt] = {}
            for component in self.components:
                poses = component.T_component_scan
                members = sorted(poses)
                steps = self.steps(members)
                degree = {n: sum(1 for m in members if steps.get((n, m)) == 1) for n in members}
                found = []
                for k, j in enumerate(members):
                    for i in members[k + 1 :]:
                        few = min(degree[i], degree[j]) < CONFIRMED or steps.get((i, j), 99) >= ROUND_TRIP
                        if few and (i, j) not in self.links and self.possible(i, j):
                            T = np.linalg.inv(poses[j]) @ poses[i]
                            shared = self.overlap(i, j, T)
                            if shared >= SHARED:
                                found.append((-shared, i, j, T))
                count: dict[int, int] = {}
                for _, i, j, T in sorted(found, key=lambda x: x[:3]):
                    if min(count.get(i, 0), count.get(j, 0)) < 2:
                        attempts[i, j] = self.attempt(i, j, "pose", T)
                        count[i], count[j] = count.get(i, 0) + 1, count.get(j, 0) + 1
            if not attempts:
                return
            self.register([attempts[p] for p in sorted(attempts)])

    def steps(self, members: list[int]) -> dict[tuple[int, int], int]:
        """How many aligned links lie between scans, up to ROUND_TRIP."""
        near: dict[int, set[int]] = {n: set() for n in members}
        for (i, j), link in self.links.items():
            if link.status == "aligned" and i in near and j in near:
                near[i].add(j)
                near[j].add(i)
        found = {}
        for n in members:
            seen, front = {n}, {n}
            for step in range(1, ROUND_TRIP):
                front = {m for k in front for m in near[k]} - seen
                seen |= front
                found.update({(n, m): step for m in front})
        return found

    def try_dear_starts(self) -> bool:
        """For scans that are still apart, ``align`` as it is for a pair alone, on the few most promising pairs."""
        if len(self.components) == 1:
            return False
        pairs = [p for p in self.looks if (*sorted(p), "auto") not in self.tried and tuple(sorted(p)) not in self.never]
        pairs = self.leading_out(sorted(pairs, key=lambda p: (-self.looks[p].promise, p)), DEAR)
        pairs = sorted(pairs, key=lambda p: (-self.looks[p].promise, p))
        pairs = pairs[: max(2, int(DEAR_SHARE * len(self.edges)))]
        self.register([self.attempt(*p, "auto") for p in sorted(pairs)])
        return bool(pairs)

    # The network.

    def network(self) -> Network:
        """The adjusted network: poses from the graph, then from the joint refinement; a word on each scan and link."""
        return adjustment.adjust(self)


def flipped(link: Link) -> Link:
    """The link with its higher scan as the source."""
    if link.source > link.target:
        return link
    hypotheses = [Hypothesis(np.linalg.inv(h.T_target_source), h.confidence) for h in link.hypotheses]
    A = pose_graph.adjoint(link.T_target_source)
    return replace(
        link, source=link.target, target=link.source, hypotheses=hypotheses, information=A.T @ link.information @ A
    )


def size_of(path: Path | None) -> tuple[int, int] | None:
    """Bytes and time of change, which tell whether a file is still the same."""
    if path is None or not path.exists():
        return None
    status = path.stat()
    return status.st_size, status.st_mtime_ns
