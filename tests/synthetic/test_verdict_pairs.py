"""Each kind of pair keeps what it promises: its poses are right, all of them, and the rest is contradicted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fmr_cli.cloud import transform_points
from fmr_cli.synthetic import repeating, sensors, structures
from fmr_cli.synthetic.draft import CONTRADICTING, Draft, Redraw, denied, on_details
from fmr_cli.synthetic.sensors import CELLS, overlap, surface_scan
from fmr_cli.synthetic.structures import Structure
from fmr_cli.synthetic.verdict_pairs import FAMILIES, KINDS, MAKERS, VerdictPair, fresh_pair, make_pair

SEVERAL = (
    "facade", "facade, a door in one", "stairs, the middle", "columns", "rack", "seats",
    "corridor, doors at equal distances", "pipe", "gear", "flange", "table", "box", "bottle",
)  # fmt: skip
NONE = (*(k for k in FAMILIES["contradiction"] if k != "furniture moved"), "nothing but no-returns", "unrelated")
OPEN = ("plane", "tunnel", "sphere", "parallel walls", "2-D corridor")
UNIQUE = tuple(k for k in KINDS if k not in (*SEVERAL, *NONE, *OPEN))
DAILY = {next(iter(kinds)) for kinds in FAMILIES.values()} | {"table", "2-D room", "mirrored room"}
EACH = [kind if kind in DAILY else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]


def draft_of(kind: str, seed: int) -> Draft:
    rng = np.random.default_rng((seed, *kind.encode()))
    while True:
        try:
            return MAKERS[kind](rng)
        except Redraw:
            continue


class Pairs(dict[str, VerdictPair]):
    """A pair of each kind, made when it is asked for: test processes make those of their own tests."""

    def __missing__(self, kind: str) -> VerdictPair:
        self[kind] = fresh_pair(kind, 5, 0)
        return self[kind]


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return Pairs()


def near(pair: VerdictPair, T: np.ndarray, share: float = 0.02) -> float:
    """The share of the source's surface within ``share`` of the size of the target."""
    return float((cKDTree(pair.target).query(transform_points(T, pair.probes))[0] < share * pair.size).mean())


@pytest.mark.parametrize("kind", EACH)
def test_a_pair_is_what_it_says(pairs, kind):
    pair = pairs[kind]
    for points in (pair.source, pair.target):
        assert points.shape[1] == 3
        assert points.dtype == np.float64
        assert 300 <= len(points) <= 100_000
        assert np.isfinite(points).all()
    assert pair.kind == kind
    for T in pair.poses[:: max(len(pair.poses) // 20, 1)]:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        assert pair.is_right(T)
    count = 0 if kind in NONE else 1
    assert len(pair.poses) >= 2 if kind in SEVERAL else len(pair.poses) == count
    assert pair.unique == (kind in UNIQUE)
    assert not pair.is_right(structures.motion(shift=[0, 0, 1e3 * pair.size]))


@pytest.mark.parametrize("kind", [k for k in EACH if (k if isinstance(k, str) else k.values[0]) not in NONE])
def test_the_scans_meet_at_the_poses_that_are_right(pairs, kind):
    pair = pairs[kind]
    least = 0.05 if "10 to 30" in kind else 0.1  # of points, which are denser near a sensor
    for T in pair.poses[:: max(len(pair.poses) // 20, 1)]:
        assert near(pair, T) > least
        apart = T.copy()
        apart[:3, 3] += 2 * pair.size  # as far apart as it takes for nothing to meet
        assert near(pair, apart) == 0


def test_the_same_number_gives_the_same_pair():
    for kind in ("facade, street furniture", "object, 30 to 60 %"):
        one, again, other = fresh_pair(kind, 1, 2), fresh_pair(kind, 1, 2), fresh_pair(kind, 1, 3)
        np.testing.assert_array_equal(one.source, again.source)
        np.testing.assert_array_equal(one.poses, again.poses)
        assert one.source.shape != other.source.shape or not np.allclose(one.source, other.source)
    with pytest.raises(KeyError):
        make_pair("teapot", np.random.default_rng(0))


STRUCTURES = {
    "facade": lambda rng: structures.facade(rng, -40, 40),
    "stairs": lambda rng: structures.stairs(rng, -20, 20),
    "columns": lambda rng: structures.columns(rng, -12, 12),
    "rack": lambda rng: structures.rack(rng, -12, 12),
    "seats": lambda rng: structures.seats(rng, -5, 5),
    "corridor": lambda rng: structures.corridor(rng, -20, 20, True),
    "pipe": lambda rng: structures.pipe(rng, -6, 6, False),
    "gear": lambda rng: structures.gear(rng, False),
    "flange": lambda rng: structures.flange(rng, False),
    "table": lambda rng: structures.table(rng, False),
    "box": lambda rng: structures.box(rng, False),
    "bottle": lambda rng: structures.bottle(rng, False),
}
INNER = {"facade": 12, "stairs": 1, "columns": 4, "rack": 3, "seats": 2, "corridor": 5, "pipe": 2}


def to_surface(s: Structure, points: np.ndarray) -> np.ndarray:
    """How far each point lies from the nearest solid's surface, along the unit solid's own radius: exact where zero."""
    best = np.full(len(points), np.inf)
    for kind, A in zip(s.scene.kinds, s.scene.maps, strict=True):
        u = (points - A[:3, 3]) @ np.linalg.inv(A[:3, :3]).T
        reach = {
            0: np.abs(u).max(1),
            1: np.linalg.norm(u, axis=1),
            2: np.maximum(np.linalg.norm(u[:, :2], axis=1), np.abs(u[:, 2])),
        }[kind]
        half = np.linalg.norm(A[:3, :3], axis=0).max()
        best = np.minimum(best, np.abs(reach - 1) * half)
    return best


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_symmetries_map_the_endless_structure_onto_itself(name, seed):
    rng = np.random.default_rng(seed)
    s = STRUCTURES[name](rng)
    facing = np.array([0.6, -30, 60]) if name in ("stairs", "facade", "rack") else None
    points = surface_scan(s.scene, rng, 400, facing, s.shells).points
    middle = INNER.get(name, 100)
    inner = (np.abs(points[:, :2]) < middle).all(1) if name != "facade" else (np.abs(points[:, 0]) < middle)
    if name in ("facade", "rack"):
        inner &= (points[:, 1] > -0.9 * (8 if name == "facade" else 3)) & (points[:, 1] < 0.1) & (points[:, 2] > -0.01)
    if name == "seats":
        inner &= points[:, 2] > -3
    if name == "columns":
        inner &= (points[:, 2] > -0.01) & (points[:, 2] < 5)
    points = points[inner][:: max(inner.sum() // 400, 1)]
    assert len(points) > 100
    assert to_surface(s, points).max() < 1e-6  # the measure itself
    np.testing.assert_array_equal(s.symmetries[0], np.eye(4))
    small = [S for S in s.symmetries if np.linalg.norm(transform_points(S, np.zeros((1, 3)))) < 1.6 * middle]
    assert len(small) > 1 or len(s.turns) > 1
    for S in small[:40]:
        for turn in s.turns[::17]:
            moved = transform_points(S @ turn, points)
            assert (to_surface(s, moved) < 1e-6).mean() > 0.97, name


DETAILED = [kind for kind in KINDS if kind in repeating.MAKERS and kind in UNIQUE]


@pytest.mark.parametrize("kind", [*DETAILED[:3], *(pytest.param(k, marks=pytest.mark.slow) for k in DETAILED[3:])])
def test_details_show_in_both_scans_and_contradict_every_alias(kind, monkeypatch):
    seen = []
    keep = repeating.unique

    def noting(structure, source, target):
        draft = keep(structure, source, target)
        seen.append(structure)
        return draft

    monkeypatch.setattr(repeating, "unique", noting)
    draft = draft_of(kind, 2)
    structure, size = seen[-1], min(draft.source.size, draft.target.size)
    tree = cKDTree(draft.target.points)
    details = draft.source.points[on_details(structure, draft.source.points)]
    assert len(details) > 10
    assert (tree.query(details)[0] < 2 * size / CELLS).sum() > 10
    away = []
    for S in structure.symmetries[1:]:
        if overlap(transform_points(S, draft.source.points), draft.target.points)[0] > 0.4:
            moved = transform_points(S, details)
            away.append((tree.query(moved)[0] > size / 70).sum())
    assert min(away, default=99) >= 4  # the rest of the contradiction is the target's details, unseen by the source


def drawn(kind: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Structure, Draft]:
    """A pair of a kind that fits in several ways, and its structure."""
    seen, keep = [], repeating.several

    def noting(structure, source, target):
        seen.append(structure)
        return keep(structure, source, target)

    with monkeypatch.context() as patch:
        patch.setattr(repeating, "several", noting)
        draft = draft_of(kind, seed)
    return seen[-1], draft


@pytest.mark.parametrize("kind", [*SEVERAL[:3], *(pytest.param(k, marks=pytest.mark.slow) for k in SEVERAL[3:])])
def test_what_the_scans_show_tells_no_alias_from_the_truth(kind, monkeypatch):
    structure, draft = drawn(kind, 1, monkeypatch)
    aliases = draft.aliases[:: max(len(draft.aliases) // 40, 1)]
    assert denied(structure, draft.source, draft.target, np.eye(4)) == 0
    assert max(denied(structure, draft.source, draft.target, S) for S in aliases) < CONTRADICTING
    off = structures.motion(shift=0.1 * draft.source.size * np.ones(3))  # no symmetry of any of them
    assert denied(structure, draft.source, draft.target, off) > CONTRADICTING


def test_stairs_turned_over_are_no_alias_where_the_other_scan_saw_air(monkeypatch):
    """A zigzag is its own image under a half turn; what else was seen of the steps may not be."""
    dropped = 0
    for seed in range(6):
        structure, draft = drawn("stairs, the middle", seed, monkeypatch)
        turned = [S for S in structure.symmetries if S[1, 1] < 0]
        over = [S for S in turned if denied(structure, draft.source, draft.target, S) >= CONTRADICTING]
        assert not any(np.array_equal(S, T) for S in over for T in draft.aliases)
        dropped += len(over)
    assert dropped > 0


def test_a_corridor_with_doors_on_both_sides_lists_it_turned_about_any_of_them(monkeypatch):
    """Half a turn about the middle of what was seen lays it on itself, give or take half a period."""
    both = 0
    for seed in range(8):
        structure, draft = drawn("corridor, doors at equal distances", seed, monkeypatch)
        if not any(S[0, 0] < 0 for S in structure.symmetries):
            continue
        both += 1
        period = min(abs(S[0, 3]) for S in structure.symmetries[1:] if S[0, 0] > 0)
        middle = np.mean([(s.view[0][0] + s.view[1][0]) / 2 for s in (draft.source, draft.target)])
        axes = [S[0, 3] / 2 for S in draft.aliases if S[0, 0] < 0]
        assert min(abs(np.array(axes) - middle)) <= 0.251 * period  # axes are half a period apart
    assert both > 1


def test_clearance_is_the_distance_to_what_is_solid():
    s = Structure()
    s.box([0, 0, 0], [2, 1, 1])
    s.add(2, [10, 0, 0], [1, 1, 3])
    points = np.array([[3.0, 2, 0.5], [1, 0.5, 0.9], [10, 3, 1], [10, 0, 5], [10, 4, 7]])
    np.testing.assert_allclose(sensors.clearance(s.scene, points), [2**0.5, -0.1, 2, 2, 5], atol=1e-12)
    np.testing.assert_allclose(sensors.clearance(s.scene, points[1:2], shells=[0]), [0.1], atol=1e-12)


def test_a_mirrored_room_has_no_right_pose(pairs):
    """Even the best of many rigid poses leaves part of the furniture without a counterpart."""
    draft = draft_of("mirrored room", 4)
    source, target = draft.source, draft.target
    for degrees in (0, 180):
        turn = structures.motion(structures.about([0, 0, 1], degrees))
        moved = transform_points(turn, source.points)
        assert min(overlap(moved, target.points, source.size / 70)) < 0.86
    truth = source.points * [-1, 1, 1]
    assert min(overlap(truth, target.points, source.size / 70)) > 0.7  # the improper one fits
    assert pairs["mirrored room"].displacement(np.eye(4)) == np.inf
    assert not pairs["mirrored room"].is_right(np.eye(4))


@pytest.mark.parametrize("kind", [k for k in FAMILIES["shy"] if "%" in k])
def test_overlap_is_in_its_band(kind):
    low, high = (float(x) / 100 for x in kind.split(", ")[1].removesuffix(" %").split(" to "))
    draft = draft_of(kind, 1)
    assert low <= min(overlap(draft.source.points, draft.target.points)) <= high


def test_overlap_counts_surface_not_points():
    rng = np.random.default_rng(0)
    left, right = rng.random((4000, 3)) * [1, 1, 0], rng.random((400, 3)) * [1, 1, 0] + [0.5, 0, 0]
    dense = np.vstack([left, rng.random((40_000, 3)) * [0.1, 1, 0]])  # a corner scanned ten times as densely
    for source in (left, dense):
        assert overlap(source, right, 0.1)[0] == pytest.approx(0.55, abs=0.05)
    assert overlap(left, left + 10) == (0.0, 0.0)


def test_strays_are_where_a_sensor_puts_them():
    zeros = fresh_pair("no-returns at the origin", 3, 0)
    np.testing.assert_array_equal(zeros.source_origin, np.zeros(3))
    assert (zeros.source == 0).all(1).mean() > 0.01
    far = fresh_pair("far outliers", 3, 0)
    assert np.linalg.norm(far.source, axis=1).max() > 10 * far.size
    ranges = fresh_pair("no-returns at maximum range", 3, 0)
    reach = np.linalg.norm(ranges.source - ranges.source_origin, axis=1)
    assert np.isclose(reach, reach.max(), rtol=1e-6).mean() > 0.05
    assert np.linalg.norm(ranges.probes - ranges.source_origin, axis=1).max() < 1.01 * reach.max()


def test_a_surface_is_sampled_evenly_and_only_where_it_shows():
    s = Structure()
    s.box([0, 0, 0], [2, 1, 1])
    s.box([0.5, 0.2, 0.5], [1.0, 0.6, 3.0])  # half of it inside the first
    points = surface_scan(s.scene, np.random.default_rng(0), 3000).points
    area = 10 - 0.5 * 0.4 + 2 * 2.0 * 0.9 + 0.5 * 0.4
    assert len(points) == pytest.approx(3000 * area, rel=0.03)
    assert not sensors.inside(s.scene.maps[0], 0, points, -1e-3).any()
    top = surface_scan(s.scene, np.random.default_rng(0), 3000, np.array([1, 0.5, 50])).points
    assert (np.isclose(top[:, 2], 1) | np.isclose(top[:, 2], 3)).all()


def test_flat_scans_stay_flat(pairs):
    for kind in ("2-D room", "2-D corridor"):
        assert np.ptp(pairs[kind].source[:, 2]) == 0
        assert np.ptp(pairs[kind].target[:, 2]) == 0
