"""The pictures of the documentation, each from the code: python docs/pictures.py [NAME ...]; needs the extra [eval]."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure

from fmr_cli import align, align_many, read_cloud, read_transform
from fmr_cli.cloud import PointCloud, transform_points
from fmr_cli.evaluation.heldout import Setting, draw, errors
from fmr_cli.evaluation.truth import read_truth
from fmr_cli.feature_metric.encoder import Encoder
from fmr_cli.feature_metric.solver import make_template, solve
from fmr_cli.registration.models import bundled_encoder, load_encoder
from fmr_cli.report.sequence_picture import write_picture
from fmr_cli.sequence import SequenceOptions, align_sequence, find_scans
from fmr_cli.synthetic.batches import Pairs
from fmr_cli.synthetic.examples import write_building, write_drive
from fmr_cli.synthetic.shapes import others

FOLDER = Path(__file__).parent / "pictures"
SOURCE, TARGET = "#d1495b", "#00798c"
SEED = 0


def hero() -> Figure:
    """Two scans of the example building, each in its own frame; and merged by the transform that was found."""
    with tempfile.TemporaryDirectory() as folder:
        paths = write_building(Path(folder), 2, SEED)
        b, a = (read_cloud(path).points for path in paths)
        T_world_b = read_transform(paths[0].with_suffix(".pose.txt"))
    found = align(PointCloud(a), PointCloud(b))
    figure = Figure((12, 4.2), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, cloud, colour, name in ((axes[0], a, SOURCE, "source"), (axes[1], b, TARGET, "target")):
        axis.scatter(*cloud[:, :2].T, s=0.6, color=colour, linewidths=0)
        axis.set(title=f"{name}, as its scanner saw it")
    # From above, at the height of the furniture; the target's true pose only says where up is.
    for cloud, colour in ((b, TARGET), (transform_points(found.T_target_source, a), SOURCE)):
        world = transform_points(T_world_b, cloud)
        level = world[(world[:, 2] > 0.15) & (world[:, 2] < 2.5)]
        axes[2].scatter(*level[:, :2].T, s=1.5, color=colour, linewidths=0, alpha=0.6)
    x, y = T_world_b[:2, 3]
    axes[2].set(
        title=f"{found.status}, confidence {found.confidence:.2f}, seen from above",
        xlim=(x - 5.5, x + 5.5), ylim=(y - 4, y + 5.5),
    )  # fmt: skip
    for axis in axes:
        axis.set(aspect="equal", xticks=[], yticks=[])
        axis.set_frame_on(False)
    return figure


def building() -> Figure:
    """The example building from above: every scan where `fmr multiway` puts it, a colour each."""
    with tempfile.TemporaryDirectory() as folder:
        paths = write_building(Path(folder), 20, SEED)
        network = align_many(paths)
        clouds = [read_cloud(path).points for path in paths]
        true = [read_transform(path.with_suffix(".pose.txt")) for path in paths]
    placed = [
        (scan, cloud, T) for scan, cloud, T in zip(network.scans, clouds, true, strict=True) if scan.component == 0
    ]
    up = placed[0][2] @ np.linalg.inv(placed[0][0].T_component_scan)  # only says where up is
    figure = Figure((7, 7), layout="constrained")
    axis = figure.subplots()
    colours = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, len(placed)))
    for (scan, cloud, _), colour in zip(placed, colours, strict=True):
        world = transform_points(up @ scan.T_component_scan, cloud)
        level = world[(world[:, 2] > 0.15) & (world[:, 2] < 2.5)]
        axis.scatter(*level[:, :2].T, s=0.3, color=colour, linewidths=0)
    axis.set(aspect="equal", xticks=[], yticks=[], title=f"{len(placed)} of {len(clouds)} scans in one frame")
    axis.set_frame_on(False)
    return figure


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
            axis.plot(error_by_iteration(encoder, pairs, 10, robust), "o-", color=colour, label=label)
        axis.axhline(5, color="0.7", linestyle=":")
        axis.set(title=f"{overlap:.0%} overlap", xlabel="iteration", yscale="log")
    axes[0].set_ylabel("median rotation error, deg")
    axes[0].legend(fontsize="small")
    return figure


@torch.inference_mode()
def error_by_iteration(encoder: Encoder, pairs: Pairs, iterations: int, robust: bool) -> list[float]:
    """The median rotation error before the first step and after each one."""
    template, g = make_template(encoder, pairs.target), torch.eye(4).repeat(len(pairs), 1, 1)
    found = [errors(g, pairs.truth).median]
    for _ in range(iterations):  # a step does not depend on how many follow
        g = solve(encoder, template, pairs.source, g, 1, robust).g
        found.append(errors(g, pairs.truth).median)
    return found


def drive() -> None:
    """The drive of the tutorial, as `fmr sequence --truth` draws it."""
    with tempfile.TemporaryDirectory() as folder:
        write_drive(Path(folder), 60, SEED)
        options, scans = SequenceOptions(), find_scans(Path(folder))
        truth = read_truth(Path(folder) / "poses.txt", scans.chosen, scans.total)
        write_picture(FOLDER / "drive.png", align_sequence(scans, None, options), scans, options, truth)


PICTURES: dict[str, Callable[[], Figure | None]] = {
    f.__name__: f for f in (hero, building, anchors, convergence, drive)
}


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or PICTURES:
        figure = PICTURES[name]()  # or it has written the picture itself, in the style of the tool's own
        if figure is not None:
            figure.savefig(FOLDER / f"{name}.png", dpi=110)
        print(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
