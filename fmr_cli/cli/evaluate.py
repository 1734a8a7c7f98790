"""`fmr evaluate`: the field's benchmarks, and the paper's experiments on the user's clouds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from fmr_cli.cli.console import progress, say, warn
from fmr_cli.cli.options import Dask, Quiet, Report, check_report, chosen_workers
from fmr_cli.errors import FmrError

if TYPE_CHECKING:
    from fmr_cli.evaluation.benchmark import Outcome
    from fmr_cli.evaluation.experiments import Row
    from fmr_cli.evaluation.plan import OnDataset, OnPairsOfItsOwn, OnScans
    from fmr_cli.workers import Workers

FEATURES = "features"  # the maps of the paper's Figure 7: plots alone, no table
EXPERIMENTS = "rotation,density,noise,overlap,scenes,features"
POINTS = 1024  # of each cloud in them, the paper's
PAIRS = 40  # at each level of an experiment: a standard error of 0.08 at most; the default takes minutes


def evaluate_command(
    scans: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of a data set, or a CSV of pairs; or folders of scans or meshes, each a set of its own. "
            "Without any, refine and cross-source run on made-up ones.",
            show_default=False,
        ),
    ] = None,
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
            help=f"The paper's, comma-separated: {EXPERIMENTS.replace(',', ', ')}. refine: ways to take the "
            "last step compared, under noise, thinning, outliers, between sensors. cross-source: photogrammetry onto "
            "other sensors.",
            show_default="all of the paper's, where SCANS are no data set",
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
    points: Annotated[
        int | None,
        typer.Option(help="Of each cloud, in the experiments.", min=16, show_default=f"{POINTS}; refine: 8192"),
    ] = None,
    iterations: Annotated[int, typer.Option(help="Of the solver.", min=1)] = 10,
    plain: Annotated[bool, typer.Option("--plain/--no-plain", help="The paper's plain least squares as well.")] = True,
    workers: Annotated[
        int, typer.Option(help="Pairs, or levels, at a time; the seconds are honest with 1.", min=1)
    ] = 1,
    dask: Dask = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same pairs.", min=0)] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where the encoder runs.")] = "auto",
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Measure recall, errors, the verdict and seconds: `fmr align`, the solver alone, and others beside them.

    On a data set of pairs with their truth, right is what each benchmark says; published figures stand beside, marked
    as quoted. On a folder of scans, the paper's experiments: errors by initial rotation, density, noise and overlap, of
    random pairs of centred clouds; lengths are in units of the cloud (its largest extent about 1).
    """
    scans = scans or []
    from fmr_cli.cores import usable_cores
    from fmr_cli.evaluation.datasets import recognised
    from fmr_cli.evaluation.plan import Compared, OnDataset, OnPairsOfItsOwn, OnScans, absolute

    check_report(report)
    if dataset and experiments:
        raise FmrError("--dataset and --experiments: give one of the two; the experiments draw pairs of their own")
    if not scans and not experiments:
        raise FmrError("no SCANS: give a data set or folders of scans, or --experiments refine or cross-source")
    name = dataset or (None if experiments else recognised(scans))
    chosen = [] if name else chosen_experiments(experiments or EXPERIMENTS)
    if not scans and (unable := [name for name in chosen if not_made_up(name)]):
        raise FmrError(f"--experiments {','.join(unable)}: give folders of scans; `fmr example objects` makes some")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FmrError(f"{out}: cannot make this folder ({error.strerror}); give another --out") from None
    threads = 1 if workers > 1 or dask else min(usable_cores(), 2)  # 2: as `fmr align`
    compared = Compared(
        absolute(model or []), with_align, with_baselines, plain, iterations, seed, threads, device
    )  # fmt: skip
    with chosen_workers(workers if workers > 1 or not dask else None, dask, quiet) as team:
        if name:
            run_dataset(OnDataset(name, absolute(scans), compared, pairs), team, out, quiet, report)
        else:
            count = pairs or PAIRS
            plan = OnScans(absolute(scans), compared, clouds, count, points or POINTS)
            own = OnPairsOfItsOwn(absolute(scans), clouds, count, points, seed)
            rows = run_experiments(chosen, plan, own, team, out, quiet)
    if report and not name:
        from fmr_cli.report.evaluation_page import write_evaluation

        said = {"scans": ", ".join(map(str, scans)), "methods": ", ".join(dict.fromkeys(row.method for row in rows))}
        said["experiments"] = ", ".join(chosen)
        write_evaluation(report, rows, said | {"pairs": count, "iterations": iterations, "seed": seed})
    say(f"written to {out}", quiet=quiet)


def run_dataset(
    plan: OnDataset, team: int | Workers | None, out: Path, quiet: bool, report: Path | None = None
) -> None:
    """The methods on a data set: its table printed, results.csv, pairs.csv and a plot in ``out``, and the report."""
    from fmr_cli.evaluation.benchmark import summarise
    from fmr_cli.evaluation.quoted import quoted
    from fmr_cli.report.benchmark import plot, table, write_pairs, write_results
    from fmr_cli.report.plots import can_plot
    from fmr_cli.workers.local import on_this_machine

    data, _, missing = plan.made()
    warn(*data.notes, *dict.fromkeys(missing), quiet=quiet)
    rows = run_pairs(plan, on_this_machine(team, len(data.pairs)), quiet)
    measured, others = summarise(rows, data.by_scene), quoted(data.name)
    write_pairs(out / "pairs.csv", rows)
    write_results(out / "results.csv", data, measured, others)
    if can_plot():
        plot(out / "errors.png", data, rows)
    if report:
        from fmr_cli.report.evaluation_page import write_dataset

        scans = ", ".join(map(str, plan.paths))
        write_dataset(report, data, measured, others, rows, {"scans": scans, "data set": plan.name})
    Console(highlight=False).print(table(data, measured, others))
    unread = [row for row in rows if row.status == "failed"]
    if unread:
        first = unread[0]
        warn(f"{len(unread)} of {len(rows)} rows failed and count as wrong; the first: {first.method}, {first.message}",
             quiet=quiet)  # fmt: skip


def run_pairs(plan: OnDataset, team: Workers, quiet: bool) -> list[Outcome]:
    """Every method on every pair; Ctrl-C ends it with the pairs that are done."""
    data, methods, _ = plan.made()
    rows: list[Outcome] = []
    with progress(quiet) as bar:
        task = bar.add_task(data.name, total=len(data.pairs), said="")
        done = plan.run(team)
        try:
            for several in done:
                rows += several
                bar.advance(task)
        except KeyboardInterrupt:
            done.close()
            if not rows:
                raise
            warn(f"stopped: the figures are of {len(rows) // len(methods)} pairs", quiet=quiet)
    return rows


def run_experiments(
    chosen: list[str], plan: OnScans, own: OnPairsOfItsOwn, team: int | Workers | None, out: Path, quiet: bool
) -> list[Row]:
    """Experiments: tables printed, results.csv and plots in ``out``.

    plan: for the paper's; own: for those that make their pairs.
    """
    from fmr_cli.evaluation.catalogue import EXPERIMENTS
    from fmr_cli.report.evaluation import plot, table, write_csv
    from fmr_cli.report.plots import can_plot
    from fmr_cli.workers.local import on_this_machine

    papers = [name for name in chosen if not_made_up(name)]
    sets, missing = (plan.made()[0], plan.made()[2]) if papers else (own.made(), [])
    warn(*(line for read in sets for line in read.skipped), *missing, quiet=quiet)
    if own.paths and "cross-source" in chosen:
        warn("cross-source: its pairs are made up, whatever the scans", quiet=quiet)
    plots = can_plot()
    if not plots:
        warn("no plots, matplotlib is not installed; pip install 'fmr-cli[eval]'", quiet=quiet)
    rows: list[Row] = []
    for name in chosen:
        if name == FEATURES:
            if plots:
                plot_features(plan, out)
            continue
        experiment, how = EXPERIMENTS[name], plan if name in papers else own
        found = [row for level in how.run(experiment, on_this_machine(team, 2)) for row in level]
        Console(highlight=False).print(table(experiment, found))
        if plots and len(experiment.levels) > 1:
            plot(out / f"{name}.png", experiment, found)
        rows += found
        write_csv(out / "results.csv", rows)
    return rows


def chosen_experiments(text: str) -> list[str]:
    """The names in a comma-separated list, groups as what they stand for. Raises FmrError for one that there is not."""
    from fmr_cli.evaluation.catalogue import EXPERIMENTS, GROUPS, PAPER

    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in (*EXPERIMENTS, *GROUPS, FEATURES):
            known = [*PAPER, FEATURES, *GROUPS, *(name for name in EXPERIMENTS if name not in PAPER)]
            raise FmrError(f"--experiments {name}: no such experiment; choose from {', '.join(known)}")
    return [one for name in names for one in GROUPS.get(name, (name,))]


def not_made_up(name: str) -> bool:
    """Whether an experiment needs scans."""
    from fmr_cli.evaluation.catalogue import PAPER

    return name == FEATURES or name in PAPER


def plot_features(plan: OnScans, out: Path) -> None:
    """The feature maps of every encoder on the first cloud, a PNG each."""
    from fmr_cli.evaluation.experiments import feature_maps
    from fmr_cli.registration.models import encoder
    from fmr_cli.report.evaluation import plot_maps

    sets, what = plan.made()[0], plan.compared
    for path in what.models or [None]:
        maps = feature_maps(encoder(path, what.device), sets[0], plan.points, what.seed)
        plot_maps(out / f"features_{path.stem if path else 'bundled'}.png", maps)
