"""Points as a page carries them: few, centred, in base64; and small pictures of them."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmr_cli.cloud import transform_points
from fmr_cli.geometry.sampling import sample

SHOWN = 30_000  # points of each cloud of a pair: what software rendering still turns smoothly, 0.5 MB in base64
SIDE = 120  # pixels of a small picture
TARGET, SOURCE = (0, 114, 178), (213, 130, 0)  # RGB: blue and orange, told apart with every kind of colour vision


def shown(points: np.ndarray, count: int = SHOWN, seed: int = 0) -> np.ndarray:
    """At most ``count`` points in random order, so that the first n are an even choice as well."""
    rng = np.random.default_rng(seed)
    return rng.permutation(sample(points, count, rng))


def raw(values: np.ndarray) -> str:
    """An array's bytes in base64."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def packed(values: np.ndarray) -> str:
    """Numbers as little-endian float32 in base64."""
    return raw(values.astype("<f4"))


def packed_shares(values: np.ndarray, limit: float) -> str:
    """Numbers from 0 to ``limit`` as 16 bits in base64; what is beyond it as the largest."""
    shares = np.clip(np.nan_to_num(values / max(limit, 1e-300), nan=1.0), 0, 1)
    return raw(np.round(shares * 65535).astype("<u2"))


@dataclass(frozen=True)
class Plane:
    """The plane of a picture. axes: the two axes shown; box: (2, 2) low and high along them."""

    axes: tuple[int, int]
    box: np.ndarray


def broad_side(points: np.ndarray, margin: float = 0.05) -> Plane:
    """The view along the shortest side of the box about the middle 98 % of the points: of rooms and streets from above.

    Where two sides are about as short, along z.
    """
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    size = high - low
    along = 2 if size[2] < 1.3 * size.min() else int(size.argmin())
    axes = [a for a in range(3) if a != along]
    middle, reach = (low + high)[axes] / 2, size[axes].max() * (0.5 + margin)
    return Plane((axes[0], axes[1]), np.stack([middle - reach, middle + reach]))


def picture(clouds: list[tuple[np.ndarray, tuple[int, int, int]]], plane: Plane, side: int = SIDE) -> str:
    """Clouds (points (N, 3), RGB) seen along an axis, as the data URI of a PNG with a clear ground.

    Where two meet in one pixel it takes the colour of both in equal parts.
    """
    from PIL import Image

    total, weight = np.zeros((side, side, 3)), np.zeros((side, side))
    for points, rgb in clouds:
        xy = (points[:, plane.axes] - plane.box[0]) / (plane.box[1] - plane.box[0])
        column, row = (xy * side).astype(int).T
        inside = ((xy >= 0) & (xy < 1)).all(1)
        hit = np.zeros((side, side), bool)
        hit[side - 1 - row[inside], column[inside]] = True
        total[hit] += rgb
        weight[hit] += 1
    image = np.zeros((side, side, 4), np.uint8)
    image[..., :3] = total / np.maximum(weight, 1)[..., None]
    image[..., 3] = np.where(weight > 0, 255, 0)
    return data_uri(Image.fromarray(image).quantize(16))


def ground(xy: np.ndarray, box: np.ndarray) -> str:
    """Points (N, 2) within ``box`` (2, 2), low and high, as a grey picture of their density, a PNG's data URI."""
    from PIL import Image

    return data_uri(Image.fromarray(density(xy, box)).quantize(12))


def density(xy: np.ndarray, box: np.ndarray, side: int = 900) -> np.ndarray:
    """(h, w, 4) uint8, the longer side so many pixels: grey on a clear ground, the denser the points the less clear."""
    size = box[1] - box[0]
    width, height = np.maximum((size / size.max() * side).astype(int), 1)
    column, row = ((xy - box[0]) / size * [width, height]).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    count = np.zeros((height, width))
    np.add.at(count, (height - 1 - row[inside], column[inside]), 1)
    most = np.quantile(count[count > 0], 0.98) if inside.any() else 1.0
    image = np.full((height, width, 4), 128, np.uint8)
    image[..., 3] = np.where(count > 0, 60 + 160 * np.minimum(count / most, 1), 0)
    return image


def data_uri(image: Any) -> str:
    """A Pillow image as a PNG within the page."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def pair_picture(source: np.ndarray, target: np.ndarray, T_target_source: np.ndarray) -> str:
    """A pair at a pose: the target blue, the source orange."""
    moved = transform_points(T_target_source, source)
    return picture([(target, TARGET), (moved, SOURCE)], broad_side(target))
