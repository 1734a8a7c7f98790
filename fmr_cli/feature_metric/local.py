"""Local patch features, invariant to rotation: where a global feature cannot know what the other scan does not have.

A patch is the neighbourhood of a keypoint, turned into its own frame (a local reference frame after TOLDI, Yang et al.
2017) and encoded by a small PointNet of the encoder's kind: a shared MLP, a max over points, two layers. All lengths
are in voxel edges, so that nothing depends on a unit.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

PATCH_RADIUS = 8.0  # voxel edges
NEIGHBOURS = 256  # looked up in a patch: about what a surface holds within the radius
PATCH_POINTS = 64  # of them, encoded
CHANNELS = 10
FLAT = 0.01  # patch radii: below it, heights say nothing


class LocalEncoder(nn.Module):
    """(K, PATCH_POINTS, CHANNELS) patches -> (K, 32) unit descriptors."""

    def __init__(
        self, point_widths: tuple[int, ...] = (64, 128, 128), head_widths: tuple[int, ...] = (128, 32)
    ) -> None:
        super().__init__()
        self.point_widths, self.head_widths = tuple(point_widths), tuple(head_widths)
        self.point = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise((CHANNELS, *point_widths)))
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise((point_widths[-1], *head_widths)))

    def forward(self, patches: Tensor) -> Tensor:
        x = patches
        for layer in self.point:
            x = torch.relu(layer(x))
        x = x.amax(-2)
        for layer in self.head[:-1]:
            x = torch.relu(layer(x))
        return nn.functional.normalize(self.head[-1](x), dim=-1)


def reference_frames(offsets: Tensor, valid: Tensor, normal: Tensor) -> Tensor:
    """A frame per patch: offsets (K, n, 3) from the keypoint in patch radii, valid (K, n), normal (K, 3) -> (K, 3, 3).

    Rows are the axes. z is the normal, its sign taken so that the patch lies on its negative side; x is the sum of the
    offsets' tangential parts, near and high points weighted most; both survive a changed sampling. Of a flat patch, x
    points to where most of it lies, so that an outline has features too.
    """
    height = torch.einsum("kni,ki->kn", offsets, normal) * valid
    z = torch.where(height.sum(-1, keepdim=True) > 0, -normal, normal)
    height = torch.einsum("kni,ki->kn", offsets, z) * valid
    near = (1 - offsets.norm(dim=-1)).clamp_min(0).square() * valid
    tangential = offsets - height[..., None] * z[:, None]
    x = ((near * (height.square() + FLAT**2))[..., None] * tangential).sum(1)
    x = x - (x * z).sum(-1, keepdim=True) * z
    x = nn.functional.normalize(x, dim=-1, eps=1e-12)
    return torch.stack([x, torch.linalg.cross(z, x), z], 1)


def describe_patches(offsets: Tensor, valid: Tensor, normal: Tensor, neighbour_normals: Tensor) -> Tensor:
    """The encoder's input: offsets (K, n, 3) in patch radii, nearest first, ... -> (K, PATCH_POINTS, CHANNELS).

    Channels: the position in the patch's frame, the products of the normal's components there (which have no sign to
    guess), and the distance. The points taken are evenly spaced in the order of distance, so even over the patch.
    """
    frame = reference_frames(offsets, valid, normal)
    count = valid.sum(1, keepdim=True).clamp_min(1)
    steps = (torch.arange(PATCH_POINTS, device=offsets.device) + 0.5) / PATCH_POINTS
    chosen = (steps * count).long()  # [K x PATCH_POINTS]
    index = chosen[..., None].expand(-1, -1, 3)
    p = offsets.gather(1, index) @ frame.mT
    n = neighbour_normals.gather(1, index) @ frame.mT
    products = torch.stack(
        [
            n[..., 0] ** 2, n[..., 1] ** 2, n[..., 2] ** 2,
            n[..., 0] * n[..., 1], n[..., 0] * n[..., 2], n[..., 1] * n[..., 2],
        ],
        -1,
    )  # fmt: skip
    return torch.cat([p, products, p.norm(dim=-1, keepdim=True)], -1)
