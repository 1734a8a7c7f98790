"""Mirrored and left-handed clouds; two units of length."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.errors import CloudFileError, OptionsError, RegistrationError
from fmr_cli.geometry.surface import Surface
from fmr_cli.io import read_transform, write_transform
from fmr_cli.io.transforms import as_transform
from fmr_cli.registration import Options, align, mirror, pipeline
from fmr_cli.registration.mirror import MIRROR
from fmr_cli.registration.pipeline import mirror_look, prepare
from fmr_cli.registration.units import factor_of
from fmr_cli.vectors import turn_vectors


@pytest.fixture(scope="module")
def clouds(room_scans: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, PointCloud]:
    return room_scans[0][::2], PointCloud(room_scans[1][::2])


def test_a_mirrored_scan_is_found_on_request_only(tmp_path: Path, clouds: tuple[np.ndarray, PointCloud]) -> None:
    points, target = clouds
    source = PointCloud(points[:, [1, 0, 2]] + [5, 0, 0])  # x and y swapped, as of a left-handed file
    plain = align(source, target)
    assert plain.status != "aligned"
    assert any("the mirror image of the source fits" in said for said in plain.warnings)
    assert mirror_look(prepare(PointCloud(points)), prepare(target), Options()) is None
    found = align(source, target, Options(allow_mirror=True))
    assert (found.status, found.mirrored) == ("aligned", True)
    assert np.linalg.det(found.T_target_source[:3, :3]) == pytest.approx(-1)
    assert np.abs(transform_points(found.T_target_source, source.points) - points).max() < 0.05
    write_transform(tmp_path / "T.txt", found.T_target_source)
    assert np.array_equal(read_transform(tmp_path / "T.txt", mirror=True), found.T_target_source)
    with pytest.raises(CloudFileError, match="would shear or mirror"):
        read_transform(tmp_path / "T.txt")


def test_an_image_is_found_beside_a_pose_that_fits_worse_and_none_beside_a_better_one(
    clouds: tuple[np.ndarray, PointCloud],
) -> None:
    points, cloud = clouds
    source, target = prepare(PointCloud(points)), prepare(cloud)
    right = align(source, target, hints=False)
    assert mirror_look(source, target, Options(), beside=right) is None
    mirrored = prepare(PointCloud(points * [1, -1, 1]))
    wrong = align(mirrored, target, hints=False)
    assert wrong.status != "aligned"
    assert mirror_look(mirrored, target, Options(), beside=wrong) is not None


def test_an_image_is_looked_for_beside_the_overlap_of_the_pose_found(
    clouds: tuple[np.ndarray, PointCloud], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target, told = prepare(PointCloud(clouds[0])), prepare(clouds[1]), []
    look = pipeline.coarse_look
    monkeypatch.setattr(pipeline, "coarse_look", lambda *args, known: told.append(known) or look(*args, known=known))
    mirror_look(source, target, Options())
    mirror_look(source, target, Options(), beside=align(source, target, hints=False))
    assert told[0] == 0
    assert told[-1] > 0.5


def test_an_image_has_the_voxels_of_the_cloud_itself(clouds: tuple[np.ndarray, PointCloud]) -> None:
    source = prepare(PointCloud(clouds[0] + [5, 7, 9]))
    image, flip = source.mirrored(), [-1, 1, 1]
    anew = Surface(image.points, source.edge)
    own, seen = source.surface(source.edge), image.surface(source.edge)
    assert np.array_equal(seen.points, own.points * flip)
    assert np.array_equal(seen.normals, own.normals * flip)
    assert np.array_equal(seen.solid, own.solid)
    assert len(anew.points) == pytest.approx(len(seen.points), rel=0.1)
    assert np.array_equal(image.frame.leave(image.points), source.frame.leave(source.points) * flip)
    assert np.array_equal(seen.tree.query(seen.points)[1], np.arange(len(seen.points)))
    again = image.mirrored()
    assert np.array_equal(again.points, source.points)


def test_where_the_mirror_image_fits_better_a_pose_is_not_believed(clouds: tuple[np.ndarray, PointCloud]) -> None:
    points, target = clouds
    right = align(PointCloud(points), target)
    image = mirror_look(prepare(PointCloud(points * [1, -1, 1])), prepare(target), Options())
    assert right.status == "aligned"
    assert mirror.unlikely(right)
    assert image is not None
    part = replace(
        right, evidence=right.evidence | {"explained_share": 0.2, "contradicted": right.evidence["explained"]}
    )
    assert not mirror.unlikely(part)
    doubted = mirror.weighed(part, image)
    assert doubted.status == "uncertain"
    assert doubted.confidence <= mirror.EITHER
    smooth = replace(part, evidence=part.evidence | {"contradicted": 0})  # a corner and a wall of a mirrored room
    assert not mirror.unlikely(smooth)
    assert mirror.weighed(smooth, image).status == "uncertain"
    assert "the mirror image of the source fits better" in doubted.reasons[0]
    assert mirror.weighed(replace(right, evidence=right.evidence | {"explained_share": 1.0}), image).status == "aligned"


def test_a_mirror_moves_vectors_and_keeps_lengths() -> None:
    T = np.diag([-2.0, 2, 2, 1])
    assert as_transform(T, mirror=True) is not None
    given = {"nx": np.array([0.6]), "ny": np.array([0.8]), "nz": np.array([0.0]), "vx": np.array([1.0]),
             "vy": np.array([2.0]), "vz": np.array([3.0])}  # fmt: skip
    moved = turn_vectors(given, T)
    assert [float(moved[n][0]) for n in ("nx", "ny", "nz")] == pytest.approx([-0.6, 0.8, 0])
    assert [float(moved[n][0]) for n in ("vx", "vy", "vz")] == pytest.approx([-2, 4, 6])


def test_a_mirror_turns_splats_as_ellipsoids() -> None:
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec([0.3, -0.5, 0.9])
    axes = np.diag([1.0, 4.0, 9.0])
    x, y, z, w = R.as_quat()
    splat = {f"rot_{k}": np.array([v]) for k, v in enumerate((w, x, y, z))}
    moved = turn_vectors(splat, MIRROR)
    q = [float(moved[f"rot_{k}"][0]) for k in (1, 2, 3, 0)]
    Q = Rotation.from_quat(q).as_matrix()
    expected = MIRROR[:3, :3] @ R.as_matrix() @ axes @ R.as_matrix().T @ MIRROR[:3, :3]
    np.testing.assert_allclose(Q @ axes @ Q.T, expected, atol=1e-12)


def test_units(clouds: tuple[np.ndarray, PointCloud]) -> None:
    points, target = clouds
    found = align(PointCloud(points * 1000), target, Options(unit="mm:m"))
    assert found.status == "aligned"
    assert found.scale == pytest.approx(0.001)
    assert np.abs(transform_points(found.T_target_source, points * 1000) - points).max() < 0.05
    with pytest.raises(
        RegistrationError, match=r"source were in millimetres and the target in metres: say --unit mm:m"
    ):
        align(PointCloud(points * 1000), target)
    assert factor_of("ft:m") == 0.3048
    assert factor_of("US-ft : ft") == pytest.approx(1.000002)
    with pytest.raises(OptionsError, match="such as mm:m"):
        factor_of("furlong:m")
