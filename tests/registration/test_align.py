"""What ``align`` promises: the right transform in any unit, the same one every time, and a status to be trusted."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import fmr_cli
from fmr_cli import PointCloud, align
from fmr_cli.errors import FmrError, RegistrationError
from fmr_cli.registration import looks
from fmr_cli.registration.options import Options
from fmr_cli.registration.pipeline import prepare
from fmr_cli.registration.prepared import Prepared, pair_edge
from fmr_cli.registration.result import Registration
from fmr_cli.synthetic import scenes
from fmr_cli.synthetic.verdict_pairs import fresh_pair

Scans = tuple[np.ndarray, np.ndarray]


def pose(axis_angle: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(axis_angle)).as_matrix()
    T[:3, 3] = shift
    return T


def before(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The points that T moves onto ``points``."""
    return (points - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T


def off(found: Registration, truth: np.ndarray, source: np.ndarray) -> tuple[float, float]:
    """Degrees between the rotations, and how far a point of the source ends from its place, at most."""
    R = found.T_target_source[:3, :3] / found.scale
    angle = Rotation.from_matrix(R @ truth[:3, :3].T).magnitude()
    gap = (source @ (found.T_target_source - truth)[:3, :3].T) + (found.T_target_source - truth)[:3, 3]
    return float(np.degrees(angle)), float(np.linalg.norm(gap, axis=1).max())


ANY = pose((130.0, -60.0, 75.0), (4.0, -7.0, 2.0))  # 161 deg
LEVEL = pose((0.0, 0.0, 140.0), (1.5, -2.0, 0.0))  # keeps z


@pytest.fixture(scope="module")
def turned(room_scans: Scans) -> tuple[Prepared, Prepared]:
    """The room's scans, the first turned and moved away by the inverse of ANY; prepared once for many tests."""
    return prepare(PointCloud(before(ANY, room_scans[0]))), prepare(PointCloud(room_scans[1]))


@pytest.fixture(scope="module")
def found(turned: tuple[Prepared, Prepared]) -> Registration:
    return align(*turned)


@pytest.fixture(scope="module")
def level(room_scans: Scans) -> tuple[Prepared, Prepared]:
    return prepare(PointCloud(before(LEVEL, room_scans[0]))), prepare(PointCloud(room_scans[1]))


# The answer.


def test_any_start_and_part_overlap_by_default(found: Registration, room_scans: Scans) -> None:
    degrees, metres = off(found, ANY, before(ANY, room_scans[0]))
    assert degrees < 0.2
    assert metres < 0.03
    assert found.status == "aligned"
    assert found.confidence > 0.9
    assert 0.4 < found.overlap < 0.9
    assert found.inlier_rmse < found.voxel_size / 4  # to the surface; the next point is half a voxel off
    assert found.feature_error_after < found.feature_error_before
    assert found.angle == pytest.approx(np.degrees(Rotation.from_matrix(ANY[:3, :3]).magnitude()), abs=0.2)


@pytest.mark.parametrize(("unit", "offset"), [
    (1000.0, (0.0, 0.0, 0.0)), (0.001, (0.0, 0.0, 0.0)), (1.0, (5e6, 4.5e5, 0.0)),
])  # fmt: skip
def test_any_unit_and_any_origin_give_the_same_answer(
    found: Registration, room_scans: Scans, unit: float, offset: tuple[float, float, float]
) -> None:
    place = np.array(offset)
    source, target = before(ANY, room_scans[0]) * unit + place, room_scans[1] * unit + place
    here = align(PointCloud(source), PointCloud(target))
    expected = ANY.copy()
    expected[:3, 3] = ANY[:3, 3] * unit + place - ANY[:3, :3] @ place
    degrees, length = off(here, expected, source)
    assert degrees < 0.2
    assert length < 0.03 * unit
    assert here.status == "aligned"
    assert here.voxel_size == pytest.approx(found.voxel_size * unit, rel=1e-3)
    assert here.inlier_rmse == pytest.approx(found.inlier_rmse * unit, rel=0.05)
    assert here.overlap == pytest.approx(found.overlap, abs=0.02)


def test_a_turned_lidar_scan(shared_data: Path) -> None:
    folder = shared_data / "kitti_seq"
    poses = np.loadtxt(folder / "reference_poses.txt").reshape(-1, 3, 4)
    first, tenth = (np.vstack([poses[i], [0, 0, 0, 1]]) for i in (0, 10))
    turn = pose((0.0, 0.0, 90.0), (0.0, 0.0, 0.0))
    truth = np.linalg.inv(tenth) @ first @ np.linalg.inv(turn)
    source, target = (fmr_cli.read_cloud(folder / "velodyne" / f"{i:06d}.bin") for i in (0, 10))
    here = align(source.transformed(turn), target)
    angle = Rotation.from_matrix(here.T_target_source[:3, :3] @ truth[:3, :3].T).magnitude()
    assert np.degrees(angle) < 1
    assert np.linalg.norm(here.T_target_source[:3, 3] - truth[:3, 3]) < 0.3
    assert here.status == "aligned"


def test_fragments_of_a_real_kitchen(shared_data: Path) -> None:
    folder = shared_data / "redkitchen" / "fragments"
    i, j = (p.stem.removesuffix(".pose") for p in sorted(folder.glob("*.pose.txt"))[:2])
    target_pose, source_pose = (np.loadtxt(folder / f"{name}.pose.txt") for name in (i, j))
    target, source = (fmr_cli.read_cloud(folder / f"{name}.ply") for name in (i, j))
    truth = np.linalg.inv(target_pose) @ source_pose @ np.linalg.inv(ANY)
    here = align(source.transformed(ANY), target)
    angle = Rotation.from_matrix(here.T_target_source[:3, :3] @ truth[:3, :3].T).magnitude()
    centre = ANY[:3, :3] @ source.points.mean(0) + ANY[:3, 3]
    assert np.degrees(angle) < 5
    assert np.linalg.norm((here.T_target_source - truth)[:3] @ [*centre, 1]) < 0.1
    assert here.status == "aligned"


# The same answer every time.


def same(a: Registration, b: Registration) -> bool:
    mine, theirs = ({k: v for k, v in r.to_dict().items() if k != "seconds"} for r in (a, b))
    return mine == theirs


def test_the_same_bits_from_fresh_clouds(found: Registration, room_scans: Scans) -> None:
    again = align(PointCloud(before(ANY, room_scans[0])), PointCloud(room_scans[1]))
    assert same(again, found)


def test_the_same_bits_in_threads_that_share_a_cloud(
    found: Registration, turned: tuple[Prepared, Prepared], room_scans: Scans
) -> None:
    target = prepare(PointCloud(room_scans[1]))
    sources = [prepare(PointCloud(before(ANY, room_scans[0])))]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda s: align(s, target), [*sources, turned[0]]))
    assert all(same(r, found) for r in results)


def test_another_seed_gives_the_same_pose_but_for_noise(room_scans: Scans, found: Registration) -> None:
    other = align(PointCloud(before(ANY, room_scans[0])), PointCloud(room_scans[1]), Options(seed=7))
    assert off(other, found.T_target_source, before(ANY, room_scans[0]))[1] < 0.03


# A status that can be trusted.


def test_scans_of_different_places_are_uncertain(room_scans: Scans) -> None:
    rng = np.random.default_rng(70)
    other = scenes.room_scan(scenes.room(rng), rng, np.array([0.0, 0.0, 1.5]), 2.0, views=3)
    thing = scenes.thing_scan(scenes.thing(rng), rng, np.array([1.0, 0.5, 0.3]), 3) * 4  # of the room's size
    for points, init in ((other, "auto"), (thing, "features")):
        some = PointCloud(rng.permutation(points)[:3_000])
        assert align(some, PointCloud(room_scans[1][::4]), Options(init=init)).status == "uncertain"  # type: ignore[arg-type]


def test_a_wrong_pose_that_is_given_is_not_called_aligned(turned: tuple[Prepared, Prepared]) -> None:
    wrong = pose((0.0, 90.0, 0.0), (0.0, 0.0, 0.0)) @ ANY
    assert align(*turned, Options(init=wrong, max_angle=None)).status == "uncertain"


def test_a_corridor_is_named() -> None:
    rng = np.random.default_rng(0)
    along, across = rng.uniform(-4, 4, 8_000), rng.uniform(-1, 1, 8_000)
    side = rng.integers(0, 4, 8_000)
    walls = np.choose(side[:, None], [np.stack(w, 1) for w in (
        (along, across, 0 * along - 1), (along, across, 0 * along + 1),
        (along, 0 * along - 1, across), (along, 0 * along + 1, across),
    )])  # fmt: skip
    walls += rng.normal(0, 0.003, walls.shape)
    here = align(PointCloud(walls[::2]), PointCloud(walls[1::2]), Options(init="identity"))
    assert here.undetermined == ["shift along (1.00, 0.00, 0.00)"]


def test_a_hall_is_held_by_the_few_things_in_it() -> None:
    """A hall of columns with some boxes: against floor and ceiling they are hardly any information along one way."""
    pair = fresh_pair("columns with things", 913, 3)
    here = align(PointCloud(pair.source), PointCloud(pair.target))
    assert (here.undetermined, here.status) == ([], "aligned")
    assert pair.is_right(here.T_target_source)


def test_covariance_and_information_are_each_other_s_inverse(found: Registration, room_scans: Scans) -> None:
    assert found.information.shape == found.covariance.shape == (6, 6)
    np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-6)
    np.testing.assert_allclose(found.information @ found.covariance, np.eye(6), atol=1e-6)
    degrees, metres = np.degrees(np.sqrt(np.diag(found.covariance)[:3])), np.sqrt(np.diag(found.covariance)[3:])
    assert (degrees > 1e-4).all()
    assert (degrees < 1).all()
    assert (metres > 1e-5).all()
    assert (metres < 0.03).all()
    np.testing.assert_allclose(found.origin, room_scans[1].mean(0))
    assert found.undetermined == []


# Options.


def test_the_default_start_is_auto() -> None:
    assert Options().init == "auto"


@pytest.mark.parametrize("dof", ["yaw", "planar"])
def test_a_level_motion_keeps_the_vertical(level: tuple[Prepared, Prepared], room_scans: Scans, dof: str) -> None:
    here = align(*level, Options(dof=dof, init="features"))  # type: ignore[arg-type]
    degrees, metres = off(here, LEVEL, before(LEVEL, room_scans[0]))
    assert degrees < 0.2
    assert metres < 0.03
    np.testing.assert_allclose(here.T_target_source[2, :3], [0, 0, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(here.T_target_source[:2, 2], 0, rtol=0, atol=1e-12)
    if dof == "planar":
        assert abs(here.T_target_source[2, 3]) < 1e-12
    assert here.status == "aligned"


def test_another_axis_may_be_the_vertical(room_scans: Scans) -> None:
    swap = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()  # z up becomes -y up
    source, target = before(LEVEL, room_scans[0]) @ swap.T, room_scans[1] @ swap.T
    here = align(PointCloud(source), PointCloud(target), Options(dof="yaw", up=(0.0, -2.0, 0.0), init="features"))
    np.testing.assert_allclose(here.T_target_source[:3, :3], swap @ LEVEL[:3, :3] @ swap.T, atol=3e-3)
    np.testing.assert_allclose(here.T_target_source[1, :3], [0, 1, 0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("dof", [*(pytest.param(d, marks=pytest.mark.slow) for d in ("yaw", "translation")), "planar"])
def test_a_constraint_holds_where_the_data_speak_against_it(turned: tuple[Prepared, Prepared], dof: str) -> None:
    here = align(*turned, Options(dof=dof, init="features"))  # type: ignore[arg-type]
    T = here.T_target_source
    np.testing.assert_allclose(T[2, :3], [0, 0, 1], rtol=0, atol=1e-12)
    if dof == "translation":
        np.testing.assert_allclose(T[:3, :3], np.eye(3), rtol=0, atol=1e-12)
    if dof == "planar":
        assert abs(T[2, 3]) < 1e-12
    assert here.status == "uncertain"


def test_a_shift_alone(room_scans: Scans) -> None:
    truth = pose((0.0, 0.0, 0.0), (0.7, -0.4, 0.2))
    source = before(truth, room_scans[0])
    here = align(PointCloud(source), PointCloud(room_scans[1]), Options(dof="translation"))
    assert off(here, truth, source)[1] < 0.02
    assert np.array_equal(here.T_target_source[:3, :3], np.eye(3))


@pytest.mark.parametrize(("factor", "init"), [(1 / 0.9, "features"), (0.3048, "auto"), (1000.0, "auto")])
def test_one_scale_factor(room_scans: Scans, factor: float, init: str) -> None:
    truth = ANY.copy()
    truth[:3, :3] *= factor
    source = before(truth, room_scans[0])
    here = align(PointCloud(source), PointCloud(room_scans[1]), Options(scale=True, init=init))
    assert here.scale == pytest.approx(factor, rel=3e-3)
    assert off(here, truth, source)[1] < 0.06
    assert here.status == "aligned"


def test_what_the_user_knows_bounds_the_search(level: tuple[Prepared, Prepared]) -> None:
    free = align(*level, Options(init="features"))
    assert free.angle == pytest.approx(140, abs=0.2)
    bound = align(*level, Options(max_angle=90, init="features"))
    assert bound.angle <= 90
    assert bound.status == "uncertain"
    assert align(*level, Options(init="features", max_angle=141, max_shift=free.shift + 0.1)).status == "aligned"
    near = align(*level, Options(init="features", max_shift=free.shift / 2))
    assert near.shift <= free.shift / 2
    assert near.status == "uncertain"


@pytest.mark.parametrize("init", ["identity", "given"])
def test_a_start_near_the_truth(room_scans: Scans, init: str) -> None:
    truth = pose((3.0, -4.0, 5.0), (0.1, -0.1, 0.05))
    source = before(truth, room_scans[0])
    start = pose((2.0, -2.0, 2.0), (0.1, 0.0, 0.0)) if init == "given" else init
    here = align(PointCloud(source), PointCloud(room_scans[1]), Options(init=start))  # type: ignore[arg-type]
    assert off(here, truth, source)[1] < 0.03
    assert here.start == init


def test_whole_clouds_may_start_from_their_centroids(room_scans: Scans) -> None:
    truth = pose((10.0, -12.0, 15.0), (300.0, -100.0, 50.0))
    source = before(truth, room_scans[0][::2])
    here = align(PointCloud(source), PointCloud(room_scans[0][1::2]), Options(init="centroid"))
    assert off(here, truth, source)[1] < 0.03
    assert here.start == "centroid"


@pytest.mark.parametrize("init", ["centroid", "given", pytest.param("search", marks=pytest.mark.slow)])
def test_a_planar_motion_keeps_the_height_from_any_start(level: tuple[Prepared, Prepared], init: str) -> None:
    start = LEVEL @ pose((9.0, 0.0, 0.0), (0.0, 0.0, 1.0)) if init == "given" else init  # which leaves the plane
    here = align(*level, Options(dof="planar", init=start, points=300))  # type: ignore[arg-type]
    np.testing.assert_allclose(here.T_target_source[2], [0, 0, 1, 0], rtol=0, atol=1e-12)


def test_without_the_polish_the_pose_is_right_too(turned: tuple[Prepared, Prepared], room_scans: Scans) -> None:
    here = align(*turned, Options(init="features", refine=False))
    degrees, metres = off(here, ANY, before(ANY, room_scans[0]))
    assert degrees < 1
    assert metres < 0.1
    R = here.T_target_source[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-13)  # a rotation in float64, not in float32


def test_the_iterations_of_a_given_start_are_told(turned: tuple[Prepared, Prepared]) -> None:
    assert align(*turned, Options(init=ANY)).feature_errors == [], "a start that fits as it is needs none"
    here = align(*turned, Options(init=ANY @ pose((30.0, 0.0, 0.0), (0.0, 0.0, 0.0)), iterations=3))
    assert 2 <= len(here.feature_errors) <= 4
    assert here.to_dict()["iterations"] == len(here.feature_errors) - 1


# What cannot be registered.


def test_bad_clouds_are_one_line(room_scans: Scans) -> None:
    good = PointCloud(room_scans[1])
    for points, says in (
        (room_scans[0][:9], "9 distinct points, registration needs 10"),
        (np.repeat(room_scans[0][:4], 100, 0), "4 distinct points"),
        (np.ones((500, 3)), "all 500 points are in one place"),
        (np.full((500, 3), np.nan), "0 distinct points"),
        (np.empty((0, 3)), "0 distinct points"),
    ):
        for pair in ((PointCloud(points), good), (good, PointCloud(points))):
            with pytest.raises(RegistrationError, match=says) as raised:
                align(*pair)
            assert "\n" not in str(raised.value)


def test_points_that_are_not_finite_change_nothing(room_scans: Scans, found: Registration) -> None:
    source = np.vstack([before(ANY, room_scans[0]), [[np.nan, 0, 0], [0, np.inf, 0]]])
    here = align(PointCloud(source), PointCloud(room_scans[1]))
    np.testing.assert_array_equal(here.T_target_source, found.T_target_source)


def test_thousands_of_repetitions_do_no_harm(room_scans: Scans) -> None:
    source = before(ANY, room_scans[0])
    source = np.vstack([source, np.repeat(source[:3], 5_000, 0)])
    here = align(PointCloud(source), PointCloud(room_scans[1]))
    assert off(here, ANY, source)[1] < 0.05


def test_flat_and_tiny_clouds_end_in_a_result(room_scans: Scans) -> None:
    rng = np.random.default_rng(1)
    flat = np.hstack([rng.uniform(0, 5, (400, 2)), np.zeros((400, 1))])
    line = np.outer(np.linspace(0, 1, 50), [1.0, 2.0, 3.0])
    few = rng.normal(size=(60, 3))
    for points, init in ((flat, "auto"), (line, "auto"), (few, "features")):
        here = align(PointCloud(points), PointCloud(room_scans[1][::6]), Options(init=init))  # type: ignore[arg-type]
        assert np.isfinite(here.T_target_source).all()
        assert here.status == "uncertain"
        json.dumps(here.to_dict(), allow_nan=False)


def test_a_flat_cloud_onto_itself_tells_what_it_does_not_determine() -> None:
    flat = np.random.default_rng(1).uniform(0, 1, (1500, 3)) * [1, 1, 0]
    here = align(PointCloud(flat[::2]), PointCloud(flat[1::2]), Options(init="identity"))
    assert len(here.undetermined) == 3
    assert np.isfinite(here.covariance).all()


def test_options_that_make_no_sense_are_refused(turned: tuple[Prepared, Prepared]) -> None:
    with pytest.raises(FmrError, match="--up"):
        align(*turned, Options(dof="yaw", up=(0.0, 0.0, 0.0)))
    with pytest.raises(RegistrationError, match="--voxel-size"):
        align(*turned, Options(voxel_size=1e3))


# What is written.


def test_the_metrics_are_plain_json(found: Registration) -> None:
    said = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert said["T_target_source"] == found.T_target_source.tolist()
    assert said["status"] == "aligned"
    assert said["options"]["init"] == "auto"
    assert said["versions"]["fmr"] == fmr_cli.__version__
    assert said["points"]["source"] == 12_000
    assert said["seconds"]["total"] > 0
    given = Registration(**{**vars(found), "options": Options(init=ANY), "inlier_rmse": float("inf")})
    said = json.loads(json.dumps(given.to_dict(), allow_nan=False))
    assert said["inlier_rmse"] is None
    assert said["options"]["init"] == ANY.tolist()


@pytest.mark.slow
def test_scans_far_apart_in_a_street_are_found_on_wide_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = fresh_pair("street, 30 to 60 %", 9001, 15)
    source, target = prepare(PointCloud(pair.source)), prepare(PointCloud(pair.target))
    found = align(source, target, hints=False)
    assert pair.is_right(found.T_target_source)
    assert found.status == "aligned"
    # Refined and described on voxels that are fine enough for it.
    assert found.voxel_size == looks.CLOSER[0] * pair_edge(source, target)
    monkeypatch.setattr(looks, "WIDER", looks.CLOSER)
    assert not pair.is_right(align(source, target, hints=False).T_target_source)
