"""`fmr evaluate`: the field's benchmarks, and the paper's experiments on the user's clouds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from fmr_cli.cli.console import progress, say, warn
from fmr_cli.cli.options import Quiet
from fmr_cli.errors import FmrError

if TYPE_CHECKING:
    from fmr_cli.evaluation.benchmark import Method as PairMethod
    from fmr_cli.evaluation.benchmark import Outcome
    from fmr_cli.evaluation.datasets.pair import DataSet
    from fmr_cli.evaluation.experiments import Clouds, Row
    from fmr_cli.evaluation.methods import Method
    from fmr_cli.feature_metric.encoder import Encoder
    from fmr_cli.registration.models import Device

FEATURES = "features"  # the maps of the paper's Figure 7: plots alone, no table
EXPERIMENTS = "rotation,density,noise,overlap,scenes,features"
PAIRS = 40  # at each level of an experiment: a standard error of 0.08 at most; the default takes minutes


def evaluate_command(
    scans: Annotated[
        list[Path],
        typer.Argument(
            help="Folders of a data set, or a CSV of pairs; or folders of scans or meshes, each a set of its own.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="For results.csv, pairs.csv and plots.")] = Path(
        "evaluation"
    ),
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Pairs with their truth: pairs (CSV), 3dmatch, 3dlomatch, eth, kitti, modelnet40, 7scenes, poses.",
            show_default="told by the files",
        ),
    ] = None,
    experiments: Annotated[
        str | None,
        typer.Option(
            help=f"The paper's experiments, comma-separated: {EXPERIMENTS.replace(',', ', ')}.",
            show_default="all, where SCANS are no data set",
        ),
    ] = None,
    model: Annotated[
        list[Path] | None,
        typer.Option(help="Weights to evaluate; again for more.", show_default="the bundled ones"),
    ] = None,
    with_align: Annotated[
        bool, typer.Option("--align/--no-align", help="`fmr align` itself, beside the solver alone.")
    ] = True,
    with_baselines: Annotated[
        bool,
        typer.Option("--baselines", help="PointNetLK, LM-ICP, small_gicp; FPFH + RANSAC, KISS-Matcher if installed."),
    ] = False,
    clouds: Annotated[int | None, typer.Option(help="Of each set, at most.", min=1, show_default="all")] = None,
    pairs: Annotated[
        int | None,
        typer.Option(
            help="Random pairs at each level; of a data set, at most so many, spread evenly.",
            min=1,
            show_default=f"{PAIRS}; of a data set, all",
        ),
    ] = None,
    points: Annotated[int, typer.Option(help="Of each cloud, in the experiments.", min=16)] = 1024,
    iterations: Annotated[int, typer.Option(help="Of the solver.", min=1)] = 10,
    plain: Annotated[bool, typer.Option("--plain/--no-plain", help="The paper's plain least squares as well.")] = True,
    workers: Annotated[
        int, typer.Option(help="Pairs of a data set at a time; the seconds are honest with 1.", min=1)
    ] = 1,
    seed: Annotated[int, typer.Option(help="The same seed gives the same pairs.", min=0)] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where the encoder runs.")] = "auto",
    quiet: Quiet = False,
) -> None:
    """Measure recall, errors, the verdict and seconds: `fmr align`, the solver alone, and others beside them.

    On a data set of pairs with their truth, right is what each benchmark says; published figures stand beside, marked
    as quoted. On a folder of scans, the paper's experiments: errors by initial rotation, density, noise and overlap, of
    random pairs of centred clouds; lengths are in units of the cloud (its largest extent about 1).
    """
    from fmr_cli.evaluation.datasets import recognised

    if dataset and experiments:
        raise FmrError("--dataset and --experiments: give one of the two; the experiments draw pairs of their own")
    name = dataset or (None if experiments else recognised(scans))
    chosen = [] if name else chosen_experiments(experiments or EXPERIMENTS)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FmrError(f"{out}: cannot make this folder ({error.strerror}); give another --out") from None
    if name:
        run_dataset(name, scans, out, model or [], with_align, with_baselines, pairs, iterations, plain, workers, seed,
                    quiet)  # fmt: skip
    else:
        run_experiments(chosen, scans, out, model or [], with_align, with_baselines, clouds, pairs or PAIRS, points,
                        iterations, plain, seed, device)  # fmt: skip
    say(f"written to {out}", quiet=quiet)


def run_dataset(
    name: str, scans: list[Path], out: Path, models: list[Path], with_align: bool, with_baselines: bool,
    pairs: int | None, iterations: int, plain: bool, workers: int, seed: int, quiet: bool,
) -> None:  # fmt: skip
    """The methods on a data set: its table printed, results.csv, pairs.csv and a plot in ``out``."""
    from fmr_cli.cores import usable_cores
    from fmr_cli.evaluation.benchmark import methods, summarise
    from fmr_cli.evaluation.datasets import read_dataset
    from fmr_cli.evaluation.quoted import quoted
    from fmr_cli.registration.models import fast_encoder
    from fmr_cli.registration.options import Options
    from fmr_cli.report.benchmark import plot, table, write_pairs, write_results
    from fmr_cli.report.evaluation import can_plot

    threads = 1 if workers > 1 else min(usable_cores(), 2)  # 2: as `fmr align`
    data = read_dataset(name, scans, seed).thinned(pairs)
    warn(*data.notes, quiet=quiet)
    compared: dict[str, PairMethod] = {}
    for number, path in enumerate(models or [None]):
        options = Options(model=path, seed=seed)
        own, missing = methods(
            data, options, fast_encoder(path), iterations, plain, with_baselines and not number, threads
        )
        warn(*missing, quiet=quiet)
        compared |= (
            own if path is None else {f"{key}, {path}" if "small_gicp" not in key else key: m for key, m in own.items()}
        )
    if not with_align:
        compared = {key: method for key, method in compared.items() if not key.startswith("fmr align")}
    rows = run_pairs(data, compared, workers, quiet)
    measured, others = summarise(rows, data.by_scene), quoted(data.name)
    write_pairs(out / "pairs.csv", rows)
    write_results(out / "results.csv", data, measured, others)
    if can_plot():
        plot(out / "errors.png", data, rows)
    Console(highlight=False).print(table(data, measured, others))
    unread = [row for row in rows if row.status == "failed"]
    if unread:
        first = unread[0]
        warn(f"{len(unread)} of {len(rows)} rows failed and count as wrong; the first: {first.method}, {first.message}",
             quiet=quiet)  # fmt: skip


def run_pairs(data: DataSet, compared: dict[str, PairMethod], workers: int, quiet: bool) -> list[Outcome]:
    """Every method on every pair; Ctrl-C ends it with the pairs that are done."""
    from fmr_cli.evaluation.benchmark import run

    rows: list[Outcome] = []
    with progress(quiet) as bar:
        task = bar.add_task(data.name, total=len(data.pairs), said="")
        done = run(data, compared, workers)
        try:
            for several in done:
                rows += several
                bar.advance(task)
        except KeyboardInterrupt:
            done.close()
            if not rows:
                raise
            warn(f"stopped: the figures are of {len(rows) // len(compared)} pairs", quiet=quiet)
    return rows


def run_experiments(
    chosen: list[str], scans: list[Path], out: Path, models: list[Path], with_align: bool, with_baselines: bool,
    clouds: int | None, pairs: int, points: int, iterations: int, plain: bool, seed: int, device: Device,
) -> None:  # fmt: skip
    """The paper's experiments on folders of scans."""
    from fmr_cli.evaluation.experiments import read_clouds
    from fmr_cli.registration.models import encoder, pick_device
    from fmr_cli.report.evaluation import can_plot, write_csv

    encoders = {str(path): encoder(path, device) for path in models} or {"bundled": encoder(None, device)}
    methods = chosen_methods(encoders, plain, with_align, with_baselines, iterations, device)
    sets = [read_clouds(path, clouds, points, pick_device(device)) for path in scans]
    warn(*(line for read in sets for line in read.skipped))
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


def chosen_experiments(text: str) -> list[str]:
    """The names in a comma-separated list. Raises FmrError for one that there is not."""
    from fmr_cli.evaluation.experiments import EXPERIMENTS

    names, known = [name.strip() for name in text.split(",")], [*EXPERIMENTS, FEATURES]
    for name in names:
        if name not in known:
            raise FmrError(f"--experiments {name}: no such experiment; choose from {', '.join(known)}")
    return names


def chosen_methods(
    encoders: dict[str, Encoder], plain: bool, with_align: bool, with_baselines: bool, iterations: int, device: Device
) -> dict[str, Method]:
    """What is compared, by the name in the tables; says which baselines are not installed."""
    from fmr_cli.evaluation.methods import baselines, ours, product

    methods: dict[str, Method] = {"fmr align": product()} if with_align else {}
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
