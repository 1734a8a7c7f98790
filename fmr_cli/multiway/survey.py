"""The state of one run of multiway, and what it knows of a scan and of a pair before registering anything."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import fmr_cli
from fmr_cli.errors import FmrError
from fmr_cli.geometry.frames import Frame, enter_frames
from fmr_cli.geometry.motion import Motion
from fmr_cli.multiway import claims, looks, visibility
from fmr_cli.multiway.components import Component, Join
from fmr_cli.multiway.known import ROUGH_DEGREES, ROUGH_SHARE, Known, number_of, poses_in_file
from fmr_cli.multiway.links import Journal, Link
from fmr_cli.multiway.pose_graph import Prior
from fmr_cli.multiway.scans import Scan
from fmr_cli.multiway.store import Store
from fmr_cli.multiway.workers import Threads
from fmr_cli.registration import Options
from fmr_cli.registration.models import local_encoder
from fmr_cli.registration.prepared import pair_edge
from fmr_cli.registration.result import plain

Ends = tuple[int, int]  # two scans, by number, the higher one (the source) first


@dataclass(frozen=True)
class Progress:
    """What is going on: stage, how much of it is done, and the network so far."""

    stage: str
    done: int
    total: int
    aligned: int = 0
    components: int = 0


def ends_of(a: int, b: int) -> Ends:
    """Two scans as a pair has them."""
    return max(a, b), min(a, b)


class Survey:
    """What is known so far. Scans go by their number in the list; poses are between centred frames.

    frames: of usable scans. edges: of their shared grids. messages: what is wrong or odd about a scan. looks, links: by
    pair. tried: pairs that have been registered, with the kind of start. components, joins: as ``consistency.joined``
    gives them.
    """

    def __init__(
        self,
        scans: list[Scan],
        options: Options,
        known: Known,
        out: Path | None,
        workers: Threads,
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self.scans, self.options, self.known, self.out = scans, options, known, out
        self.workers, self.report = workers, progress or (lambda _: None)
        self.name = uuid.uuid4().hex  # of this run, for what workers elsewhere keep
        self.seconds: dict[str, float] = {}
        self.messages: dict[int, str] = {}
        self.failed: set[int] = set()
        self.frames: dict[int, Frame] = {}
        self.edges: dict[int, float] = {}
        self.described: dict[tuple[int, float], looks.Description] = {}
        self.views: dict[int, visibility.Viewed] = {}
        self.shared: dict[tuple[int, int, bytes], float] = {}  # overlaps that have been worked out already
        self.compared: dict[tuple[int, int, bytes], visibility.Seen] = {}  # views that have been compared already
        self.looks: dict[Ends, looks.Look] = {}
        self.looked_by_planes: set[Ends] = set()
        self.alike: dict[int, list[int]] = {}  # by scan, those that resemble it as places and wait for a look
        self.links: dict[Ends, Link] = {}
        self.tried: set[tuple[int, int, str]] = set()
        self.components: list[Component] = []
        self.joins: dict[tuple[int, int], Join] = {}
        self.store = Store(scans, options.seed, None if out is None else out / "work")
        self.journal = Journal(None if out is None else out / "journal.jsonl", self.settings())
        self.fixed_numbers = [number_of(name, scans, "--fixed") for name in dict.fromkeys(known.fixed)]
        self.anchor = None if known.anchor is None else number_of(known.anchor, scans, "--anchor")
        self.local = local_encoder(options.model)
        self.poses = poses_in_file([scan.path for scan in scans]) | {
            number_of(name, scans, "--init-poses"): pose for name, pose in known.poses.items()
        }
        self.never: set[Ends] = set()
        self.asked: list[tuple[int, int, np.ndarray | None]] = []  # "try" and "known" links: source, target, pose
        self.given: list[tuple[int, int, np.ndarray]] = []
        self.sort_links()

    def sort_links(self) -> None:
        """Known links by their use. Raises FmrError where a scan is linked to itself or not there."""
        for link in self.known.links:
            i, j = (number_of(name, self.scans, "--links") for name in (link.source, link.target))
            if i == j:
                raise FmrError(f"--links: {link.source} is linked to itself, give two scans")
            if link.use == "never":
                self.never.add(ends_of(i, j))
            elif link.use == "known" and link.T_target_source is not None:
                self.given.append((i, j, link.T_target_source))
            else:
                self.asked.append((i, j, link.T_target_source))

    def settings(self) -> dict[str, Any]:
        """What all attempts of one journal share."""
        files = [(s.name, str(s.path), size_of(s.path)) for s in self.scans]
        known = asdict(self.known)
        return plain({"fmr": fmr_cli.__version__, "scans": files, "options": asdict(self.options), "known": known})

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the wall time of its block to the stage's."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def each(
        self,
        stage: str,
        work: Callable[[Any], Any],
        items: Sequence[Any],
        arrived: Callable[[int, Any], None] = lambda number, result: None,
        handed_out: bool = False,
    ) -> list[Any]:
        """The results of ``work`` on all items, in their order, by all workers; progress is reported as they come.

        handed_out: by the cluster's workers.
        """
        aligned = sum(link.status == "aligned" for link in self.links.values())
        done = 0

        def one(number: int, result: Any) -> None:
            nonlocal done
            done += 1
            arrived(number, result)
            self.report(Progress(stage, done, len(items), aligned, len(self.components)))

        return (self.workers.hand_out if handed_out else self.workers.map)(work, items, one)

    # A scan.

    def note(self, number: int, text: str) -> None:
        """Adds to what is odd about a scan."""
        self.messages[number] = "; ".join(filter(None, [self.messages.get(number, ""), text]))

    def description(self, number: int, edge: float | None = None) -> looks.Description:
        """What a look needs of a scan, on its own shared grid or one of ``edge``."""
        edge = edge or self.edges[number]
        if (number, edge) not in self.described:
            self.described[number, edge] = looks.describe(self.store.prepared(number), edge, self.local)
        return self.described[number, edge]

    @cached_property
    def similarity(self) -> np.ndarray:
        """How alike usable scans look as places, in the order of their numbers: (n, n)."""
        return looks.similarity([self.description(n) for n in sorted(self.edges)])

    def moment(self, number: int) -> np.ndarray:
        """(4, 4), see ``looks.Description``."""
        return self.description(number).moment

    def moments(self) -> dict[int, np.ndarray]:
        return {n: self.moment(n) for n in self.edges}

    def radius(self, number: int) -> float:
        """Root mean square distance of a scan's points from their mean, file's unit."""
        return float(np.sqrt(np.trace(self.moment(number)[:3, :3])))

    def viewed(self, number: int) -> visibility.Viewed:
        """A scan as seen from where it was taken."""
        if number not in self.views:
            self.views[number] = visibility.view(self.store.prepared(number), self.edges[number])
        return self.views[number]

    # A pair.

    def pair_edge(self, source: int, target: int) -> float:
        """The voxel edge that two scans are registered at."""
        return self.options.voxel_size or pair_edge(self.store.prepared(source), self.store.prepared(target))

    def overlap(self, source: int, target: int, T_target_source: np.ndarray) -> float:
        """The share of the smaller scan that has a counterpart at a pose; no query where they are too far apart."""
        a, b = self.description(source), self.description(target)
        if np.linalg.norm(T_target_source[:3, 3]) > a.reach + b.reach:
            return 0.0
        key = (source, target, T_target_source.tobytes())
        if key not in self.shared:
            self.shared[key] = looks.overlap(a, b, T_target_source)
        return self.shared[key]

    def seen(self, pairs: Iterable[tuple[int, int, np.ndarray]]) -> list[visibility.Seen]:
        """What the views of each pair (source, target, pose) say."""
        found = []
        for source, target, T in pairs:
            key = (source, target, T.tobytes())
            if key not in self.compared:
                self.compared[key] = visibility.compare(self.viewed(source), self.viewed(target), T)
            found.append(self.compared[key])
        return found

    def motion(self, source: int, target: int, unit: float = 1.0) -> Motion:
        """What may move between two centred frames, lengths in ``unit``."""
        up = np.asarray(self.options.up, float)
        up = up / np.linalg.norm(up)
        lift = float(up @ (self.frames[source].origin - self.frames[target].origin)) / unit
        return Motion(self.options.dof, (float(up[0]), float(up[1]), float(up[2])), lift)

    def possible(self, source: int, target: int) -> bool:
        """Whether a pair can be linked at all: not forbidden, of like scale, near enough by the poses known."""
        if ends_of(source, target) in self.never or not looks.comparable(self.edges[source], self.edges[target]):
            return False
        if source in self.poses and target in self.poses:
            T, slack = self.predicted(source, target)
            reach = self.description(source).reach + self.description(target).reach
            return bool(np.linalg.norm(T[:3, 3]) <= reach + slack)
        return True

    def allowed(self, source: int, target: int, T_target_source: np.ndarray) -> bool:
        """Whether a pose keeps to the known poses and to ``max_shift``."""
        expected = enter_frames(np.eye(4), self.frames[source], self.frames[target])
        if source in self.poses and target in self.poses:
            expected, slack = self.predicted(source, target)
            edge = claims.AGREE * max(self.edges[source], self.edges[target])
            if float(looks.displacement(T_target_source, expected, self.moment(source))) > slack + edge:
                return False
        bound = self.options.max_shift
        return bound is None or bool(np.linalg.norm(T_target_source[:3, 3] - expected[:3, 3]) <= bound)

    # Known poses.

    def predicted(self, source: int, target: int) -> tuple[np.ndarray, float]:
        """T_target_source by the known poses, and how far off that may be (three sigmas)."""
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

    def world(self) -> Frame:
        """The frame that known poses are centred by: the place of the first of them."""
        for n in [*self.fixed_numbers, *sorted(self.poses)]:
            if n in self.frames:
                pose = self.poses[n].T_world_scan if n in self.poses else np.eye(4)
                return Frame(pose[:3, :3] @ self.frames[n].origin + pose[:3, 3])
        return Frame()

    def fixed_poses(self) -> dict[int, np.ndarray]:
        """T_world_scan, files' coordinates, of the scans that don't move."""
        given = {n: self.poses[n].T_world_scan if n in self.poses else np.eye(4) for n in self.fixed_numbers}
        return {n: pose for n, pose in given.items() if n in self.edges}

    def fixed(self) -> dict[int, np.ndarray]:
        """The same between centred frames."""
        world = self.world()
        return {n: enter_frames(pose, self.frames[n], world) for n, pose in self.fixed_poses().items()}

    def priors(self) -> list[Prior]:
        """Known poses of scans that may move."""
        world = self.world()
        return [
            Prior(n, enter_frames(pose.T_world_scan, self.frames[n], world), *self.sigmas(n))
            for n, pose in sorted(self.poses.items())
            if n in self.edges and n not in self.fixed_numbers
        ]


def nearest_pairs(T_component_scan: dict[int, np.ndarray], count: int) -> list[Ends]:
    """Scans of a component, each with the ``count`` others whose centres are nearest; (higher, lower)."""
    members = sorted(T_component_scan)
    centres = np.stack([T_component_scan[n][:3, 3] for n in members])
    near = cKDTree(centres).query(centres, min(count + 1, len(members)))[1].reshape(len(members), -1)
    return sorted({ends_of(members[i], members[j]) for i, row in enumerate(near) for j in row if i != j})


def size_of(path: Path | None) -> tuple[int, int] | None:
    """Bytes and time of change, which tell whether a file is still the same."""
    if path is None or not path.exists():
        return None
    status = path.stat()
    return status.st_size, status.st_mtime_ns
