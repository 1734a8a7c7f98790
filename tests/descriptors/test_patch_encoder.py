"""Local patch features: the same place gives the same descriptor, however the scans are turned."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.descriptors.patch_encoder import (
    CHANNELS,
    FIRST_CHANNELS,
    NEIGHBOURS,
    PATCH_POINTS,
    PATCH_RADIUS,
    LocalEncoder,
    describe_patches,
    reference_frames,
)
from fmr_cli.geometry.surface import Surface
from fmr_cli.registration.models import bundled_local_encoder
from fmr_cli.training.local_task import LocalNet

Scans = tuple[np.ndarray, np.ndarray]
Patches = dict[str, np.ndarray]
TURN = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix().astype(np.float32)


@pytest.fixture(scope="module")
def surfaces(room_scans: Scans) -> tuple[Surface, Surface]:
    return Surface(room_scans[0], 0.08), Surface(room_scans[1], 0.08)


@pytest.fixture(scope="module")
def patches(surfaces: tuple[Surface, Surface]) -> Patches:
    return surfaces[0].patches(surfaces[0].keypoints(100), PATCH_RADIUS, NEIGHBOURS)


def turned(patches: Patches, flips: bool = False) -> Patches:
    out = patches | {name: patches[name] @ TURN.T for name in ("offsets", "normal", "normals")}
    if flips:  # a normal's sign is chance
        rng = np.random.default_rng(0)
        for name in ("normal", "normals"):
            out[name] = out[name] * rng.choice([-1, 1], (len(out[name]), 1)).astype(np.float32)
    return out


def frames(patches: Patches) -> np.ndarray:
    return reference_frames(patches["offsets"], patches["valid"], patches["normal"])


def test_frames_are_right_handed_and_turn_with_the_patch(patches: Patches) -> None:
    frame = frames(patches)
    np.testing.assert_allclose(frame @ np.swapaxes(frame, 1, 2), np.tile(np.eye(3), (100, 1, 1)), rtol=0, atol=1e-4)
    assert (np.linalg.det(frame) > 0.99).all()
    np.testing.assert_allclose(frames(turned(patches)), frame @ TURN.T, rtol=0, atol=5e-3)


@pytest.mark.parametrize("flips", [False, True])
def test_a_rotation_changes_no_descriptor(patches: Patches, flips: bool) -> None:
    encoder = bundled_local_encoder()
    before, after = (encoder(describe_patches(**p)) for p in (patches, turned(patches, flips)))
    assert ((before * after).sum(1) > 0.999).mean() >= 0.99


def test_descriptors_are_those_of_the_network_that_was_trained(patches: Patches, tmp_path: object) -> None:
    described = describe_patches(**patches)
    assert described.shape == (100, PATCH_POINTS, CHANNELS)
    assert np.isfinite(described).all()
    network = LocalNet()
    save_file(network.state_dict(), f"{tmp_path}/local.safetensors")
    descriptor = LocalEncoder.load(f"{tmp_path}/local.safetensors")(described)  # type: ignore[arg-type]
    with torch.no_grad():
        wanted = network(torch.from_numpy(described)).numpy()
    np.testing.assert_allclose(descriptor, wanted, rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(descriptor, axis=1), 1, rtol=1e-5)


def test_the_last_channels_do_not_depend_on_where_x_points(patches: Patches) -> None:
    described = describe_patches(**patches)
    about = Rotation.from_rotvec([0, 0, 1.0]).as_matrix().astype(np.float32)
    p = described[..., :3] @ about.T
    n = np.array([[3, 6, 7], [6, 4, 8], [7, 8, 5]])  # the channels of a normal's products
    N = about @ described[..., n] @ about.T
    outward = p[..., :2] / np.maximum(np.linalg.norm(p[..., :2], axis=-1, keepdims=True), 1e-6)
    out = np.concatenate([outward, np.zeros_like(p[..., :1])], -1)
    along = np.stack([-out[..., 1], out[..., 0], out[..., 2]], -1)

    def product(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.einsum("kni,knij,knj->kn", u, N, v)

    up = np.broadcast_to([0, 0, 1.0], p.shape)
    radius = np.linalg.norm(p[..., :2], axis=-1)
    wanted = np.stack([radius, product(out, out), product(out, up), product(out, along), product(along, up)], -1)
    np.testing.assert_allclose(described[..., FIRST_CHANNELS:], wanted, rtol=0, atol=1e-4)


def test_an_encoder_of_the_first_version_says_what_it_did(patches: Patches) -> None:
    rng = np.random.default_rng(0)
    shapes = {"point.0": (8, FIRST_CHANNELS), "point.1": (8, 8), "head.0": (32, 8)}
    arrays = {f"{name}.weight": rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    arrays |= {f"{name}.bias": np.zeros(shape[0], np.float32) for name, shape in shapes.items()}
    described = describe_patches(**patches)
    x = described[..., :FIRST_CHANNELS]
    for name in ("point.0", "point.1"):
        x = np.maximum(x @ arrays[f"{name}.weight"].T, 0)
    wanted = x.max(1) @ arrays["head.0.weight"].T
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    np.testing.assert_allclose(LocalEncoder.of(arrays)(described), wanted, rtol=0, atol=1e-5)


def test_a_patch_of_its_keypoint_alone_is_finite() -> None:
    valid = np.zeros((1, NEIGHBOURS), np.float32)
    valid[0, 0] = 1
    up = np.array([[0, 0, 1]], np.float32)
    nothing = np.zeros((1, NEIGHBOURS, 3), np.float32)
    lonely = describe_patches(nothing, valid, up, np.zeros((1, NEIGHBOURS), int), up)
    assert np.isfinite(bundled_local_encoder()(lonely)).all()


def test_the_same_place_in_another_scan_is_recognised(surfaces: tuple[Surface, Surface]) -> None:
    first, second = surfaces
    a, b = first.keypoints(500), second.keypoints(500)
    p, q = first.points[a], second.points[b]
    encoder = bundled_local_encoder()
    x, y = (encoder(describe_patches(**s.patches(i, PATCH_RADIUS, NEIGHBOURS))) for s, i in ((first, a), (second, b)))
    chosen = (x @ y.T).argmax(1)
    shared = cKDTree(q).query(p)[0] < 0.08  # places that are keypoints of both
    right = np.linalg.norm(p - q[chosen], axis=1) < 3 * 0.08
    assert shared.sum() > 50
    assert right[shared].mean() > 0.3  # by chance: 0.01
