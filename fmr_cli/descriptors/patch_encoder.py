"""Local patch features, invariant to rotation: where a global feature cannot know what the other scan does not have.

A patch is the neighbourhood of a keypoint, turned into its own frame (a local reference frame after TOLDI, Yang et al.
2017) and encoded by a small PointNet of the encoder's kind: a shared MLP, a max over points, two layers. All lengths
are in voxel edges, so that nothing depends on a unit. Trained by ``training.local_task``.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from fmr_cli.feature_metric.layers import Layers

PATCH_RADIUS = 8.0  # voxel edges
NEIGHBOURS = 256  # looked up in a patch: about what a surface holds within the radius
PATCH_POINTS = 64  # of them, encoded
CHANNELS = 15
FIRST_CHANNELS = 10  # of encoders of version 0.1: all but those that do not depend on the frame's x
FLAT = 0.01  # patch radii: below it, heights say nothing
CHUNK = 12  # patches encoded at once: their activations stay in the processor's cache


@dataclass(frozen=True)
class LocalEncoder:
    """The trained weights: of the points' MLP, and of the head."""

    point: Layers
    head: Layers

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray]) -> LocalEncoder:
        """The encoder of arrays ``point.0.weight``, ... Raises ValueError where they are none."""
        arrays = with_all_channels(arrays)
        parts = [
            [(arrays[f"{part}.{i}.weight"], arrays[f"{part}.{i}.bias"])
             for i in range(len(arrays)) if {f"{part}.{i}.weight", f"{part}.{i}.bias"} <= arrays.keys()]
            for part in ("point", "head")
        ]  # fmt: skip
        width = CHANNELS
        for weight, bias in [*parts[0], *parts[1]]:
            if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
                raise ValueError(f"a layer is {weight.shape} where {width} values come in")
            width = len(weight)
        if not all(parts) or 2 * sum(map(len, parts)) != len(arrays):
            raise ValueError("layers are missing")
        return cls(*parts)

    @classmethod
    def load(cls, path: Path) -> LocalEncoder:
        """The encoder of a file of its own, as ``models/local.safetensors`` is."""
        from safetensors.numpy import load_file

        return cls.of(load_file(path))

    def arrays(self) -> dict[str, np.ndarray]:
        """What ``of`` takes."""
        return {
            f"{part}.{i}.{kind}": array
            for part, layers in (("point", self.point), ("head", self.head))
            for i, layer in enumerate(layers)
            for kind, array in zip(("weight", "bias"), layer, strict=True)
        }

    @cached_property
    def key(self) -> str:
        """Tells encoders of other weights apart, wherever they lie in memory."""
        digest = hashlib.sha256()
        for weight, bias in [*self.point, *self.head]:
            digest.update(weight.tobytes())
            digest.update(bias.tobytes())
        return digest.hexdigest()

    def __call__(self, patches: np.ndarray) -> np.ndarray:
        """(K, PATCH_POINTS, CHANNELS) -> (K, 32) unit descriptors, CHUNK by CHUNK: more rows change no bit of these."""
        # Memory that all chunks use: the pages of fresh arrays cost a tenth of the time.
        rows = min(len(patches), CHUNK) * PATCH_POINTS
        room = [np.empty((rows, len(bias)), np.float32) for _, bias in self.point]
        return np.concatenate([self.described(patches[i : i + CHUNK], room) for i in range(0, len(patches), CHUNK)])

    def described(self, patches: np.ndarray, room: list[np.ndarray]) -> np.ndarray:
        """The descriptors of a few patches. room: for what each layer of the points' MLP gives."""
        x = self.pooled(patches, room)
        for weight, bias in self.head[:-1]:
            x = np.maximum(x @ weight.T + bias, 0)
        weight, bias = self.head[-1]
        x = x @ weight.T + bias
        return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)

    def pooled(self, patches: np.ndarray, room: list[np.ndarray]) -> np.ndarray:
        """The maximum over the points of the MLP; its last bias and ReLU come after it, which is the same."""
        x = patches.reshape(-1, patches.shape[-1])
        for (weight, _), bias, out in zip(self.point[:-1], self.late[:-1], room[:-1], strict=True):
            x = np.matmul(x, weight.T, out=out[: len(x)])
            np.maximum(x, -bias, out=x)
        x = np.matmul(x, self.point[-1][0].T, out=room[-1][: len(x)]).reshape(*patches.shape[:2], -1).max(1)
        return np.maximum(x + self.late[-1], 0)

    @cached_property
    def late(self) -> list[np.ndarray]:
        """The biases of the points' MLP as ``pooled`` adds them: one pass over an activation in place of two.

        relu(z + b) = max(z, -b) + b, and that b goes through the next layer's matrix into its bias.
        """
        late = [self.point[0][1]]
        for weight, bias in self.point[1:]:
            late.append(bias + weight @ late[-1])
        return late


def with_all_channels(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of an encoder; one of FIRST_CHANNELS is given the others, which say nothing in it."""
    first = arrays.get("point.0.weight")
    if first is None or first.ndim != 2 or first.shape[1] != FIRST_CHANNELS:
        return arrays
    return arrays | {"point.0.weight": np.pad(first, ((0, 0), (0, CHANNELS - FIRST_CHANNELS)))}


def reference_frames(offsets: np.ndarray, valid: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A frame per patch: offsets (K, n, 3) from the keypoint in patch radii, valid (K, n), normal (K, 3) -> (K, 3, 3).

    Rows are the axes. z is the normal, its sign taken so that the patch lies on its negative side; x is the sum of the
    offsets' tangential parts, near and high points weighted most; both survive a changed sampling. Of a flat patch, x
    points to where most of it lies, so that an outline has features too.
    """
    height = (offsets @ normal[..., None])[..., 0] * valid
    sign = np.where(height.sum(1) > 0, -1, 1).astype(offsets.dtype)
    z = sign[:, None] * normal
    near = np.square(np.maximum(1 - np.sqrt(np.einsum("kni,kni->kn", offsets, offsets)), 0)) * valid
    weight = near * (height * height + FLAT**2)
    # The weighted sum of offsets - height z, less what rounding leaves along z.
    x = (weight[:, None] @ offsets)[:, 0] - (sign * (weight * height).sum(1))[:, None] * z
    x -= (x * z).sum(1, keepdims=True) * z
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
    return np.stack([x, np.cross(z, x), z], 1)


def describe_patches(
    offsets: np.ndarray, valid: np.ndarray, normal: np.ndarray, neighbours: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """The encoder's input (K, PATCH_POINTS, CHANNELS), float32.

    offsets: (K, n, 3) in patch radii, nearest first; valid: (K, n); normal: (K, 3) at the keypoints; neighbours: (K, n)
    rows of normals (M, 3). Channels: the position in the patch's frame, the products of the normal's components there
    (which have no sign to guess), and the distance. Then what is the same whichever way x points, since noise and
    little shape turn x: the distance from the frame's z axis, and the products of the normal's components outward,
    along and about that axis. The points taken are evenly spaced in the order of distance, so even over the patch.
    """
    frame = np.swapaxes(reference_frames(offsets, valid, normal), 1, 2)
    count = np.maximum(valid.sum(1, keepdims=True), 1)
    chosen = ((np.arange(PATCH_POINTS, dtype=np.float32) + 0.5) / PATCH_POINTS * count).astype(int)  # [K x POINTS]
    out = np.empty((*chosen.shape, CHANNELS), np.float32)
    rows = np.arange(len(chosen))[:, None]
    p = offsets[rows, chosen] @ frame
    n = normals[neighbours[rows, chosen]] @ frame
    out[..., :3], out[..., 3:6] = p, n * n
    # Component by component: sums over an axis of two or three take several times as long.
    (x, y, z), (nx, ny, nz) = np.moveaxis(p, -1, 0), np.moveaxis(n, -1, 0)
    np.multiply(nx, ny, out=out[..., 6])
    np.multiply(nx, nz, out=out[..., 7])
    np.multiply(ny, nz, out=out[..., 8])
    across2 = x * x + y * y
    out[..., 9] = np.sqrt(across2 + z * z)
    out[..., 10] = radius = np.sqrt(across2)
    radius = np.maximum(radius, 1e-6)
    x, y = x / radius, y / radius  # outward
    n_out, n_about = nx * x + ny * y, ny * x - nx * y
    np.multiply(n_out, n_out, out=out[..., 11])
    np.multiply(n_out, nz, out=out[..., 12])
    np.multiply(n_out, n_about, out=out[..., 13])
    np.multiply(n_about, nz, out=out[..., 14])
    return out
