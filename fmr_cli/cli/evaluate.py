"""`fmr evaluate`: sets of clouds and methods in, each experiment's table as soon as it is there, files at the end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from fmr_cli.errors import FmrError
from fmr_cli.evaluation.experiments import EXPERIMENTS, feature_maps, read_clouds, run
from fmr_cli.evaluation.methods import Method, baselines, ours
from fmr_cli.registration.models import Device, encoder, pick_device
from fmr_cli.report import evaluation as report

FEATURES = "features"


def evaluate(
    scans: list[Path],
    out: Path,
    experiments: list[str],
    models: list[Path],
    with_baselines: bool,
    count: int | None,
    pairs: int,
    points: int,
    iterations: int,
    plain: bool,
    seed: int,
    device: Device,
    console: Console,
    say: Callable[[str], None],
) -> None:
    """Prints tables to the console, writes results.csv and PNGs to ``out``; ``say`` gets warnings. Raises FmrError."""
    unknown = [name for name in experiments if name not in {*EXPERIMENTS, FEATURES}]
    if unknown:
        known = ", ".join([*EXPERIMENTS, FEATURES])
        raise FmrError(f"--experiments {unknown[0]}: no such experiment; choose from {known}")
    encoders = {str(path): encoder(path, device) for path in models} or {"bundled": encoder(None, device)}
    methods: dict[str, Method] = {}
    for name, weights in encoders.items():
        methods[name] = ours(weights, iterations, True)
        if plain:
            methods[f"{name}, plain"] = ours(weights, iterations, False)
    if with_baselines:
        others, missing = baselines(device, iterations)
        methods |= others
        for line in missing:
            say(f"warning: {line}")
    sets = [read_clouds(path, count, points, pick_device(device)) for path in scans]
    for clouds in sets:
        for line in clouds.skipped:
            say(f"warning: {line}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FmrError(f"{out}: cannot make this folder ({error.strerror}); give another --out") from None
    plots = report.can_plot()
    if not plots:
        say("warning: no plots, matplotlib is not installed; pip install 'fmr-cli[eval]'")
    rows = []
    for name in experiments:
        if name == FEATURES:
            if plots:
                for label, weights in encoders.items():
                    path = out / f"features_{Path(label).stem}.png"
                    report.plot_maps(path, feature_maps(weights, sets[0], points, seed))
            continue
        own = [row for clouds in sets for row in run(EXPERIMENTS[name], clouds, methods, pairs, points, seed)]
        console.print(report.table(EXPERIMENTS[name], own))
        rows += own
        report.write_csv(out / "results.csv", rows)
        if plots and len(EXPERIMENTS[name].levels) > 1:
            report.plot(out / f"{name}.png", EXPERIMENTS[name], own)
    say(f"written to {out}")
