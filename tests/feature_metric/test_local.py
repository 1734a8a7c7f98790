"""Local patch features: the same place gives the same descriptor, however the scans are turned."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fmr_cli.feature_metric.local import (
    CHANNELS,
    NEIGHBOURS,
    PATCH_POINTS,
    PATCH_RADIUS,
    LocalEncoder,
    describe_patches,
    reference_frames,
)
from fmr_cli.preprocess import Surface
from fmr_cli.weights import bundled_local_encoder

Scans = tuple[np.ndarray, np.ndarray]
Patches = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def surfaces(room_scans: Scans) -> tuple[Surface, Surface]:
    return Surface(room_scans[0], 0.08), Surface(room_scans[1], 0.08)


def tensors(surface: Surface, index: np.ndarray) -> Patches:
    return {k: torch.from_numpy(v) for k, v in surface.patches(index, PATCH_RADIUS, NEIGHBOURS).items()}


@pytest.fixture(scope="module")
def patches(surfaces: tuple[Surface, Surface]) -> Patches:
    return tensors(surfaces[0], surfaces[0].keypoints(100))


def turned(patches: Patches, flips: bool = False) -> Patches:
    R = torch.from_numpy(Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix()).float()
    out = {k: v @ R.T if v.shape[-1] == 3 else v for k, v in patches.items()}
    if flips:  # a normal's sign is chance
        generator = torch.Generator().manual_seed(0)
        for name in ("normal", "neighbour_normals"):
            out[name] = out[name] * (torch.randint(0, 2, (*out[name].shape[:-1], 1), generator=generator) * 2 - 1)
    return out


def test_frames_are_right_handed_and_turn_with_the_patch(patches: Patches) -> None:
    R = torch.from_numpy(Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix()).float()
    frame = reference_frames(patches["offsets"], patches["valid"], patches["normal"])
    eye = torch.eye(3).expand_as(frame)
    torch.testing.assert_close(frame @ frame.mT, eye, rtol=0, atol=1e-4)
    assert (torch.linalg.det(frame) > 0.99).all()
    moved = turned(patches)
    again = reference_frames(moved["offsets"], moved["valid"], moved["normal"])
    torch.testing.assert_close(again, frame @ R.T, rtol=0, atol=2e-3)


@pytest.mark.parametrize("flips", [False, True])
def test_a_rotation_changes_no_descriptor(patches: Patches, flips: bool) -> None:
    encoder = bundled_local_encoder()
    before, after = (encoder(describe_patches(**p)) for p in (patches, turned(patches, flips)))
    assert ((before * after).sum(1) > 0.999).float().mean() >= 0.99


def test_shapes_and_unit_length(patches: Patches) -> None:
    described = describe_patches(**patches)
    assert described.shape == (100, PATCH_POINTS, CHANNELS)
    assert torch.isfinite(described).all()
    descriptor = LocalEncoder()(described)
    assert descriptor.shape == (100, 32)
    torch.testing.assert_close(descriptor.norm(dim=1), torch.ones(100))


def test_a_patch_of_its_keypoint_alone_is_finite() -> None:
    valid = torch.zeros(1, NEIGHBOURS)
    valid[0, 0] = 1
    lonely = describe_patches(
        torch.zeros(1, NEIGHBOURS, 3), valid, torch.tensor([[0, 0, 1.0]]), torch.zeros(1, NEIGHBOURS, 3)
    )
    assert torch.isfinite(bundled_local_encoder()(lonely)).all()


def test_the_same_place_in_another_scan_is_recognised(surfaces: tuple[Surface, Surface]) -> None:
    first, second = surfaces
    a, b = first.keypoints(500), second.keypoints(500)
    p, q = first.points[a], second.points[b]
    encoder = bundled_local_encoder()
    x, y = (encoder(describe_patches(**tensors(s, i))) for s, i in ((first, a), (second, b)))
    chosen = (x @ y.T).argmax(1).numpy()
    shared = cKDTree(q).query(p)[0] < 0.08  # places that are keypoints of both
    right = np.linalg.norm(p - q[chosen], axis=1) < 3 * 0.08
    assert shared.sum() > 50
    assert right[shared].mean() > 0.3  # by chance: 0.01
