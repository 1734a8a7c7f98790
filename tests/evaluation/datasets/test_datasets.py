"""Data sets in the layouts of the field: which pairs they give, with which truth, and when a pose is right."""

from __future__ import annotations

from pathlib import Path

import layouts
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmr_cli.cloud import transform_points
from fmr_cli.errors import FmrError
from fmr_cli.evaluation.datasets import read_dataset, recognised
from fmr_cli.evaluation.datasets.kitti import ten_metres
from fmr_cli.evaluation.datasets.modelnet40 import SEEN, UNSEEN
from fmr_cli.evaluation.datasets.pair import (
    CorrespondenceRmse,
    Loaded,
    Within,
    correspondence_rmse,
    errors,
    information,
)
from fmr_cli.evaluation.datasets.redwood import read_blocks, read_fragment
from fmr_cli.io import write_transform


def shifted(T: np.ndarray, by: tuple[float, float, float]) -> np.ndarray:
    T = T.copy()
    T[:3, 3] += by
    return T


def turned(T: np.ndarray, degrees: float) -> np.ndarray:
    """T after a turn about z in the source's frame."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return T @ E


def test_the_information_by_hand() -> None:
    """One point (1, 2, 3): G = [I | -2 [p]x], rows (1 0 0 0 6 -4), (0 1 0 -6 0 2), (0 0 1 4 -2 0)."""
    G = np.array([[1, 0, 0, 0, 6, -4], [0, 1, 0, -6, 0, 2], [0, 0, 1, 4, -2, 0]], float)
    np.testing.assert_allclose(information(np.array([[1.0, 2.0, 3.0]])), G.T @ G)


def test_the_rmse_of_correspondences_by_hand() -> None:
    """A shift of 0.3, 0.4, 0 moves every correspondence by 0.5; a turn moves a point 2 m from its axis by 2 angle."""
    points = np.array([[2.0, 0, 0], [0, 2, 5], [-2, 0, 1], [0, -2, 7]])
    truth = turned(shifted(np.eye(4), (10, -20, 3)), 50)
    pair = Loaded(points, transform_points(truth, points), truth, information(points))
    assert correspondence_rmse(truth, pair) == pytest.approx(0, abs=1e-9)
    shift = truth @ shifted(np.eye(4), (0.3, 0.4, 0))
    assert correspondence_rmse(shift, pair) == pytest.approx(0.5)
    # Exactly 2 * 2 sin(angle / 2), which the vector part of the quaternion gives without an approximation here
    turn = turned(truth, 6)
    assert correspondence_rmse(turn, pair) == pytest.approx(4 * np.sin(np.radians(3)))
    assert CorrespondenceRmse(0.2)(turned(truth, 5.7), pair)  # 4 sin(2.85 deg) = 0.1989
    assert not CorrespondenceRmse(0.2)(turned(truth, 5.8), pair)  # 0.2024
    assert not CorrespondenceRmse(0.2)(np.full((4, 4), np.nan), pair)


def test_within_counts_the_translation_or_where_the_centre_lands() -> None:
    """A turn by 1 deg about an origin 100 m away moves the scan by 1.745 m, and leaves the translation as it is."""
    source = np.array([[100.0, 0, 0], [102, 0, 0], [100, 2, 0], [102, 2, 1]])
    pair = Loaded(source, source, np.eye(4))
    turn = turned(np.eye(4), 1)
    assert errors(turn, pair) == pytest.approx((1, 0), abs=1e-9)
    centre = np.hypot(101, 1) * 2 * np.sin(np.radians(0.5))  # 1.763: the mean is at (101, 1, 0.25)
    assert errors(turn, pair, centred=True) == pytest.approx((1, centre), rel=1e-9)
    assert Within(5, 2)(turn, pair)
    assert not Within(0.9, 2)(turn, pair)
    assert not Within(5, 1.7, centred=True)(turn, pair)
    # 2 % of the diagonal, sqrt(4 + 4 + 1) = 3, are 0.06
    assert Within(5, share=0.02, centred=True)(shifted(np.eye(4), (0.059, 0, 0)), pair)
    assert not Within(5, share=0.02, centred=True)(shifted(np.eye(4), (0.061, 0, 0)), pair)


def test_3dmatch(tmp_path: Path) -> None:
    truths = layouts.write_3dmatch(tmp_path)
    assert recognised([tmp_path]) == "3dmatch"
    found = read_dataset("3dmatch", [tmp_path])
    assert [(p.scene, p.source, p.target) for p in found.pairs] == [
        ("7-scenes-redkitchen", "cloud_bin_2", "cloud_bin_0")  # the pairs that follow each other are not counted
    ]
    pair = found.pairs[0].load()
    np.testing.assert_allclose(pair.T_target_source, truths[0, 2], atol=1e-11)
    clouds, _ = layouts.three_fragments()
    np.testing.assert_allclose(pair.source, clouds[2], atol=1e-9)
    assert found.right(pair.T_target_source @ shifted(np.eye(4), (0.19, 0, 0)), pair)
    assert not found.right(pair.T_target_source @ shifted(np.eye(4), (0.21, 0, 0)), pair)


def test_3dmatch_with_the_ground_truth_elsewhere_and_of_two_benchmarks(tmp_path: Path) -> None:
    """As Predator has it: fragments as .pth in one folder, configs/benchmarks/3DMatch/SCENE/gt.log in another."""
    torch = pytest.importorskip("torch")
    layouts.write_3dmatch(tmp_path / "all", "lab")
    clouds, _ = layouts.three_fragments()
    data = tmp_path / "data/indoor/test/lab"
    data.mkdir(parents=True)
    for number, cloud in enumerate(clouds):
        torch.save(cloud.astype(np.float32), data / f"cloud_bin_{number}.pth")
    for benchmark in ("3DMatch", "3DLoMatch"):
        folder = tmp_path / "benchmarks" / benchmark / "lab"
        folder.mkdir(parents=True)
        for name in ("gt.log", "gt.info"):
            text = (tmp_path / "all/lab-evaluation" / name).read_text()
            rows = text.splitlines(keepends=True)
            size = len(rows) // 3
            (folder / name).write_text(text if benchmark == "3DMatch" else "".join(rows[size : 2 * size]))
    paths = [data.parent, tmp_path / "benchmarks"]
    low = read_dataset("3dlomatch", paths)
    assert low.name == "3DLoMatch"
    assert len(low.pairs) == 1
    np.testing.assert_allclose(low.pairs[0].load().source, clouds[2], atol=1e-6)
    assert read_dataset("3dmatch", paths).name == "3DMatch"


def test_a_pth_that_would_run_code_is_not_read(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    torch.save({"points": Path("x")}, tmp_path / "cloud_bin_0.pth")
    with pytest.raises(FmrError, match=r"cloud_bin_0.pth: holds no plain array"):
        read_fragment(tmp_path / "cloud_bin_0.pth")


def test_eth_leaves_out_what_hardly_overlaps(tmp_path: Path) -> None:
    overlap = np.array([[1, 0.8, 0.2], [0, 1, 0.31], [0, 0, 1]])
    layouts.write_eth(tmp_path, overlap=overlap)
    assert recognised([tmp_path]) == "eth"
    found = read_dataset("eth", [tmp_path])
    assert [(p.source, p.target) for p in found.pairs] == [("Hokuyo_1", "Hokuyo_0"), ("Hokuyo_2", "Hokuyo_1")]
    assert found.right == Within(5, 0.3)
    layouts.write_eth(tmp_path, "wood_autumn")
    assert len(read_dataset("eth", [tmp_path]).pairs) == 5


def test_kitti_pairs_end_before_ten_metres() -> None:
    """Scans 4 m apart: from 0 the first beyond 10 m is 3 (12 m), so the pair is 0 and 2; the next begins at 3."""
    positions = np.zeros((8, 3))
    positions[:, 0] = 4 * np.arange(8)
    assert ten_metres(positions) == [(0, 2), (3, 5)]  # from 6 on none is far enough
    standing = np.concatenate([np.zeros((3, 3)), positions[1:4] + np.array([2, 0, 0])])
    assert ten_metres(standing) == [(0, 4)]  # 0, 0, 0, 6, 10, 14: 10 is not further than 10


def test_kitti_truth_is_the_scanners_and_is_refined_by_icp(tmp_path: Path, street_scans: tuple) -> None:
    scans, poses = street_scans
    rough = poses.copy()
    rough[-1, :3, 3] += (0.1, 0.05, 0)  # what GPS is off by
    layouts.write_kitti(tmp_path, scans, rough)
    assert recognised([tmp_path]) == "kitti"
    found = read_dataset("kitti", [tmp_path])
    assert [(p.scene, p.source, p.target) for p in found.pairs] == [("08", "000000", "000001")]
    pair = found.pairs[0].load()
    truth = np.linalg.inv(poses[1]) @ poses[0]
    assert np.linalg.norm(pair.T_target_source[:3, 3] - truth[:3, 3]) < 0.05
    assert found.right(shifted(pair.T_target_source, (1.9, 0, 0)), pair)
    assert not found.right(shifted(pair.T_target_source, (2.1, 0, 0)), pair)
    assert not found.right(turned(pair.T_target_source, 5.1), pair)


@pytest.fixture(scope="session")
def street_scans() -> tuple[list[np.ndarray], np.ndarray]:
    """Scans from 0, 6 and 12 m along a street, and T_world_scan."""
    from simulation import drive, make_street, scan

    rng, place, poses = np.random.default_rng(1), make_street(60), drive(60)
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    chosen = poses[[int(np.searchsorted(along, d)) for d in (0, 6, 12)]]
    return [scan(place, pose, rng, columns=450) for pose in chosen], chosen


def test_kitti_without_calibration_says_so(tmp_path: Path) -> None:
    layouts.write_kitti(tmp_path, [np.ones((20, 3))] * 3, np.stack([np.eye(4)] * 3))
    (tmp_path / "sequences/08/calib.txt").unlink()
    with pytest.raises(FmrError, match=r"calib.txt: is not there or has no Tr"):
        read_dataset("kitti", [tmp_path])


def test_modelnet40_in_four_groups(tmp_path: Path) -> None:
    layouts.write_modelnet(tmp_path)
    assert recognised([tmp_path]) == "modelnet40"
    found = read_dataset("modelnet40", [tmp_path])
    assert [p.scene for p in found.pairs] == ["seen, whole", "unseen, whole", "seen, partial", "unseen, partial"]
    whole, partial = found.pairs[0].load(), found.pairs[2].load()
    np.testing.assert_allclose(transform_points(whole.T_target_source, whole.source), whole.target, atol=1e-12)
    assert whole.source.shape == (1024, 3)
    assert len(partial.source) == len(partial.target) == 717  # 0.7 of 1,024, as RPM-Net has it
    again = read_dataset("modelnet40", [tmp_path]).pairs[2].load()
    np.testing.assert_array_equal(again.source, partial.source)
    other = read_dataset("modelnet40", [tmp_path], seed=1).pairs[2].load()
    assert not np.array_equal(other.T_target_source, partial.T_target_source)


def test_modelnet40s_pairs_by_hand(tmp_path: Path) -> None:
    """20 + 20 categories by their alphabet; 4.9 deg or 0.09 off is right, 5.1 or 0.11 is not."""
    assert (len(SEEN), len(UNSEEN)) == (20, 20)
    assert [*SEEN, *UNSEEN] == sorted({*SEEN, *UNSEEN})
    layouts.write_modelnet(tmp_path)
    found = read_dataset("modelnet40", [tmp_path])
    for pair in (each.load() for each in found.pairs):
        assert np.linalg.norm(pair.source, axis=1).max() <= 1 + 0.05 * np.sqrt(3)  # the unit sphere, and the noise
        for degrees, shift in ((4.9, 0.0), (5.1, 0.0), (0.0, 0.09), (0.0, 0.11)):
            T = shifted(turned(pair.T_target_source, degrees), (shift, 0, 0))
            np.testing.assert_allclose(errors(T, pair), (degrees, shift), atol=1e-6)
            assert found.right(T, pair) == (degrees < 5 and shift < 0.1)


def test_7scenes_with_poses_and_without(tmp_path: Path) -> None:
    scene = tmp_path / "7-scenes-office"
    layouts.write_3dmatch(tmp_path / "made", "7-scenes-office")
    (tmp_path / "made/7-scenes-office").rename(scene)
    assert recognised([tmp_path / "7-scenes-office"]) == "7scenes"
    copies = read_dataset("7scenes", [scene])
    assert copies.name == "7-Scenes, moved copies"
    pair = copies.pairs[1].load()
    np.testing.assert_allclose(transform_points(pair.T_target_source, pair.source), pair.target, atol=1e-12)
    _, poses = layouts.three_fragments()
    for number, T in enumerate(poses):
        rows = "\n".join("\t ".join(f"{v:.9e}" for v in row) for row in T)
        (scene / f"cloud_bin_{number}.info.txt").write_text(f"7-scenes-office\t seq-01\t 0\t 49\t\n{rows}\n")
    posed = read_dataset("7scenes", [scene])
    assert [(p.source, p.target) for p in posed.pairs] == [("cloud_bin_2.ply", "cloud_bin_0.ply")]
    loaded = posed.pairs[0].load()
    np.testing.assert_allclose(loaded.T_target_source, np.linalg.inv(poses[0]) @ poses[2], atol=1e-7)
    assert loaded.information is not None
    assert 0.2 * len(loaded.source) < loaded.information[0, 0] <= len(loaded.source)
    assert posed.right(loaded.T_target_source @ shifted(np.eye(4), (0.19, 0, 0)), loaded)
    assert not posed.right(loaded.T_target_source @ shifted(np.eye(4), (0.21, 0, 0)), loaded)


@pytest.mark.parametrize("several", [True, False])
def test_a_folder_with_poses(tmp_path: Path, several: bool) -> None:
    folder = tmp_path / "scans"
    layouts.write_poses(folder, several)
    assert recognised([folder]) == "poses"
    found = read_dataset("poses", [folder])
    _, poses = layouts.three_fragments()
    for pair in found.pairs:  # scan8, scan9, scan10 are 0, 1, 2
        i, j = (int(name.removeprefix("scan").removesuffix(".ply")) - 8 for name in (pair.target, pair.source))
        assert i < j
        np.testing.assert_allclose(pair.load().T_target_source, np.linalg.inv(poses[i]) @ poses[j], atol=1e-12)
    assert len(found.pairs) == 3
    assert found.thinned(2).pairs == [found.pairs[0], found.pairs[2]]


def test_a_csv_of_pairs(tmp_path: Path) -> None:
    layouts.write_poses(tmp_path / "scans")
    _, poses = layouts.three_fragments()
    truth = np.linalg.inv(poses[0]) @ poses[1]
    write_transform(tmp_path / "T.txt", truth)
    numbers = " ".join(f"{v:.17g}" for v in truth[:3].ravel())
    table = tmp_path / "pairs.csv"
    table.write_text(
        "source,target,transform,scene\n"
        "scans/scan9.ply,scans/scan8.ply,T.txt,attic\n"
        f"scans/scan9.ply,scans/scan8.ply,{numbers},\n"
    )
    assert recognised([table]) == "pairs"
    found = read_dataset("pairs", [table])
    assert [p.scene for p in found.pairs] == ["attic", "pairs"]
    for pair in found.pairs:
        np.testing.assert_allclose(pair.load().T_target_source, truth, atol=1e-12)
    table.write_text("source,target,transform\nscans/scan9.ply,scans/scan8.ply,1 2 3\n")
    with pytest.raises(FmrError, match=r"pairs.csv: line 2: 3 numbers are no transform"):
        read_dataset("pairs", [table])


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    assert recognised([tmp_path]) is None
    for name in ("3dmatch", "eth", "kitti", "modelnet40", "7scenes", "poses"):
        with pytest.raises(FmrError, match=str(tmp_path)):
            read_dataset(name, [tmp_path])
    with pytest.raises(FmrError, match="no such layout; choose from pairs, 3dmatch"):
        read_dataset("4dmatch", [tmp_path])
    with pytest.raises(FmrError, match="no such folder"):
        read_dataset("eth", [tmp_path / "none"])


@pytest.mark.parametrize(
    ("text", "said"),
    [("0 1 2\n1 0 0 0\n", "no multiple of 5"), ("0 1\n" + "1 0 0 0\n" * 4, "is not i j n"), ("a b c\n", "numbers")],
)
def test_a_spoilt_log_is_said(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "gt.log").write_text(text)
    with pytest.raises(FmrError, match=said):
        read_blocks(tmp_path / "gt.log", 4)


def test_fragments_that_are_missing_are_said(tmp_path: Path) -> None:
    layouts.write_3dmatch(tmp_path, "lab")
    (tmp_path / "lab/cloud_bin_2.ply").unlink()
    with pytest.raises(FmrError, match="speaks of fragment 2"):
        read_dataset("3dmatch", [tmp_path])
    (tmp_path / "lab-evaluation/gt.info").unlink()
    with pytest.raises(FmrError, match=r"gt.info: no such file"):
        read_dataset("3dmatch", [tmp_path])
