"""`fmr evaluate`: the paper's experiments on the user's clouds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from fmr_cli.cli.console import say, warn
from fmr_cli.cli.options import Report, check_report
from fmr_cli.errors import FmrError

if TYPE_CHECKING:
    from fmr_cli.evaluation.experiments import Clouds, Row
    from fmr_cli.evaluation.methods import Method
    from fmr_cli.feature_metric.encoder import Encoder
    from fmr_cli.registration.models import Device

FEATURES = "features"  # the maps of the paper's Figure 7: plots alone, no table


def evaluate_command(
    scans: Annotated[
        list[Path], typer.Argument(help="Folders of scans or meshes; each is a set of its own.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="For results.csv and plots.")] = Path("evaluation"),
    experiments: Annotated[
        str, typer.Option(help="Comma-separated: rotation, density, noise, overlap, scenes, features.")
    ] = "rotation,density,noise,overlap,scenes,features",
    model: Annotated[
        list[Path] | None,
        typer.Option(help="Weights to evaluate; again for more.", show_default="the bundled ones"),
    ] = None,
    with_baselines: Annotated[
        bool,
        typer.Option("--baselines", help="PointNetLK, LM-ICP, small_gicp; FPFH + RANSAC, KISS-Matcher if installed."),
    ] = False,
    clouds: Annotated[int | None, typer.Option(help="Of each set, at most.", min=1, show_default="all")] = None,
    pairs: Annotated[int, typer.Option(help="Random pairs at each level.", min=1)] = 100,
    points: Annotated[int, typer.Option(help="Of each cloud.", min=16)] = 1024,
    iterations: Annotated[int, typer.Option(help="Of the solver.", min=1)] = 10,
    plain: Annotated[bool, typer.Option("--plain/--no-plain", help="The paper's plain least squares as well.")] = True,
    seed: Annotated[int, typer.Option(help="The same seed gives the same pairs.", min=0)] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where the encoder runs.")] = "auto",
    report: Report = None,
) -> None:
    """The paper's experiments on SCANS: errors by initial rotation, density, noise, overlap, as tables, CSV and plots.

    The solver alone from the identity, without the search over starts and the polish of `fmr align`. Both clouds are
    centred on their means; lengths are in units of the cloud (its largest extent about 1).
    """
    from fmr_cli.evaluation.experiments import read_clouds
    from fmr_cli.registration.models import encoder, pick_device
    from fmr_cli.report.evaluation import write_csv
    from fmr_cli.report.plots import can_plot

    check_report(report)
    chosen = chosen_experiments(experiments)
    encoders = {str(path): encoder(path, device) for path in model or []} or {"bundled": encoder(None, device)}
    methods = chosen_methods(encoders, plain, with_baselines, iterations, device)
    sets = [read_clouds(path, clouds, points, pick_device(device)) for path in scans]
    warn(*(line for read in sets for line in read.skipped))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FmrError(f"{out}: cannot make this folder ({error.strerror}); give another --out") from None
    plots = can_plot()
    if not plots:
        warn("no plots, matplotlib is not installed; pip install 'fmr-cli[eval]'")
    rows: list[Row] = []
    for name in chosen:
        if name != FEATURES:
            rows += run_experiment(name, sets, methods, pairs, points, seed, out if plots else None)
            write_csv(out / "results.csv", rows)
        elif plots:
            plot_features(encoders, sets[0], points, seed, out)
    if report:
        from fmr_cli.report.evaluation_page import write_evaluation

        options = {"scans": ", ".join(map(str, scans)), "methods": ", ".join(methods), "pairs": pairs}
        write_evaluation(report, rows, options | {"points": points, "iterations": iterations, "seed": seed})
    say(f"written to {out}")


def chosen_experiments(text: str) -> list[str]:
    """The names in a comma-separated list. Raises FmrError for one that there is not."""
    from fmr_cli.evaluation.experiments import EXPERIMENTS

    names, known = [name.strip() for name in text.split(",")], [*EXPERIMENTS, FEATURES]
    for name in names:
        if name not in known:
            raise FmrError(f"--experiments {name}: no such experiment; choose from {', '.join(known)}")
    return names


def chosen_methods(
    encoders: dict[str, Encoder], plain: bool, with_baselines: bool, iterations: int, device: Device
) -> dict[str, Method]:
    """What is compared, by the name in the tables; says which baselines are not installed."""
    from fmr_cli.evaluation.methods import baselines, ours

    methods: dict[str, Method] = {}
    for name, weights in encoders.items():
        methods[name] = ours(weights, iterations, True)
        if plain:
            methods[f"{name}, plain"] = ours(weights, iterations, False)
    if with_baselines:
        others, missing = baselines(device, iterations)
        methods |= others
        warn(*missing)
    return methods


def run_experiment(
    name: str, sets: list[Clouds], methods: dict[str, Method], pairs: int, points: int, seed: int, plots: Path | None
) -> list[Row]:
    """One experiment on all sets: its table printed, its plot in the folder ``plots``, its rows given back."""
    from fmr_cli.evaluation.experiments import EXPERIMENTS, run
    from fmr_cli.report.evaluation import plot, table

    experiment = EXPERIMENTS[name]
    rows = [row for clouds in sets for row in run(experiment, clouds, methods, pairs, points, seed)]
    Console(highlight=False).print(table(experiment, rows))
    if plots and len(experiment.levels) > 1:
        plot(plots / f"{name}.png", experiment, rows)
    return rows


def plot_features(encoders: dict[str, Encoder], clouds: Clouds, points: int, seed: int, out: Path) -> None:
    """The feature maps of every encoder, a PNG each."""
    from fmr_cli.evaluation.experiments import feature_maps
    from fmr_cli.report.evaluation import plot_maps

    for label, weights in encoders.items():
        plot_maps(out / f"features_{Path(label).stem}.png", feature_maps(weights, clouds, points, seed))
