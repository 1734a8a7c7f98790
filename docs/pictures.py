"""The pictures of the documentation, each from the code: python docs/pictures.py [NAME ...]; needs the extra [eval]."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from fmr_cli import align, read_cloud
from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.evaluation.heldout import Setting, draw, errors
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.solver import make_template, solve
from fmr_cli.registration.models import bundled_encoder, load_encoder
from fmr_cli.synthetic.examples import write_pair
from fmr_cli.synthetic.shapes import others

FOLDER = Path(__file__).parent / "pictures"
SOURCE, TARGET = "#d1495b", "#00798c"
SEED = 0


def hero() -> Figure:
    """The example's two scans, each in its own frame; and merged by the transform that was found."""
    with tempfile.TemporaryDirectory() as folder:
        a, b = (read_cloud(path).points for path in write_pair(Path(folder), 2, SEED))
    found = align(PointCloud(a), PointCloud(b))
    up = upright(b)
    figure = Figure((12, 4.6), layout="constrained")
    views = (
        ("source", [(a @ upright(a).T, SOURCE)]),
        ("target", [(b @ up.T, TARGET)]),
        (
            f"{found.status}, confidence {found.confidence:.2f}: turned by {found.angle:.0f} deg",
            [(b @ up.T, TARGET), (transform_points(found.T_target_source, a) @ up.T, SOURCE)],
        ),
    )
    for number, (title, clouds) in enumerate(views):
        axis = figure.add_subplot(1, 3, number + 1, projection="3d")
        for cloud, colour in clouds:
            low, high = np.quantile(cloud[:, 2], [0.01, 0.99])
            inside = cloud[(cloud[:, 2] < high - 0.15 * (high - low))]  # without the ceiling
            axis.scatter(*inside.T, s=0.25, color=colour, linewidths=0, alpha=0.8)
        if number == 0:
            turned = np.random.default_rng(4).normal(size=3)
            axis.view_init(elev=25 + 20 * turned[0], azim=60 * turned[1], roll=40)
        else:
            axis.view_init(elev=48, azim=-60)
        axis.set(title=title, box_aspect=np.ptp(np.concatenate([c for c, _ in clouds]), axis=0))
        axis.set_axis_off()
    return figure


def upright(points: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that makes the direction with the sharpest layers (floor, ceiling) the vertical."""
    from scipy.spatial.transform import Rotation

    best, chosen = -np.inf, np.array([0.0, 0, 1])
    for axis in Rotation.random(3000, random_state=0).apply([0, 0, 1]):
        h = np.histogram(points @ axis, bins=80)[0]
        if (h**2).sum() > best:
            best, chosen = float((h**2).sum()), axis
    if np.median(points @ chosen) > np.mean(np.quantile(points @ chosen, [0.01, 0.99])):
        chosen = -chosen
    return Rotation.align_vectors([[0, 0, 1]], chosen[None])[0].as_matrix()


def anchors() -> Figure:
    """Three channels of the bundled encoder, and of one trained on the pose loss alone, on the plane z = 0."""
    with as_file(files("fmr_cli.models") / "pointnetlk.safetensors") as path:
        without = load_encoder(path)
    grid = np.linspace(-0.6, 0.6, 121)
    x, y = np.meshgrid(grid, grid)
    points = torch.from_numpy(np.stack([x, y, 0 * x], -1).reshape(-1, 3)).float()
    figure = Figure((9, 6.2), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, (name, encoder) in zip(axes, (("with anchors", bundled_encoder()), ("without", without)), strict=True):
        with torch.inference_mode():
            values = encoder.pointwise(points).numpy()
        spread = np.argsort(-values.std(0))[: values.shape[1] // 2]  # of the livelier half, three
        for axis, channel in zip(row, spread[:: len(spread) // 3], strict=False):
            axis.imshow(
                values[:, channel].reshape(x.shape), extent=(-0.6, 0.6, -0.6, 0.6), origin="lower", cmap="viridis"
            )
            axis.add_patch(_box())
            axis.set(title=f"{name}, channel {channel}", xticks=[], yticks=[])
    return figure


def _box() -> object:
    from matplotlib.patches import Rectangle

    return Rectangle((-0.5, -0.5), 1, 1, fill=False, color="w", linestyle=":")


def convergence() -> Figure:
    """The median rotation error after each iteration, 40 deg apart: the paper's steps and the robust ones."""
    pool, encoder = torch.from_numpy(others(12, 2048, seed=5)), bundled_encoder()
    figure = Figure((10, 3.8), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for axis, overlap in zip(axes, (1.0, 0.9, 0.8), strict=True):
        pairs = draw(pool, Setting("", (40, 40), overlap=overlap), 24, 512, SEED)
        for robust, label, colour in ((False, "the paper's", "#edae49"), (True, "robust, both Jacobians", TARGET)):
            axis.plot(
                range(11), [median_error(encoder, pairs, k, robust) for k in range(11)], "o-", color=colour, label=label
            )
        axis.axhline(5, color="0.7", linestyle=":")
        axis.set(title=f"{overlap:.0%} overlap", xlabel="iteration", yscale="log")
    axes[0].set_ylabel("median rotation error, deg")
    axes[0].legend(fontsize="small")
    return figure


@torch.inference_mode()
def median_error(encoder: Encoder, pairs, iterations: int, robust: bool) -> float:  # noqa: ANN001
    start = torch.eye(4).repeat(len(pairs), 1, 1)
    if iterations == 0:
        return errors(start, pairs.truth).median
    found = solve(encoder, make_template(encoder, pairs.target), pairs.source, start, iterations, robust)
    return errors(found.g, pairs.truth).median


PICTURES: dict[str, Callable[[], Figure]] = {"hero": hero, "anchors": anchors, "convergence": convergence}


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or PICTURES:
        PICTURES[name]().savefig(FOLDER / f"{name}.png", dpi=110)
        print(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
