"""The registration options of the command line, declared once for every command that registers."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from fmr_cli.registration.options import STARTS, read_init


def option(help: str, *names: str, panel: str = "Registration", **kwargs: Any) -> Any:
    return typer.Option(*names, help=help, rich_help_panel=panel, **kwargs)


def registration_options(
    init: Annotated[str, option(f"Where to start: {', '.join(STARTS)}, or a transform file.")] = "auto",
    voxel_size: Annotated[float | None, option("Working voxel edge. [default: from the data]", min=0.0)] = None,
    normalize: Annotated[bool, option("Scale the clouds to the encoder's unit box.")] = True,
    points: Annotated[int, option("Points that the global encoder sees.", min=10)] = 1024,
    dof: Annotated[
        Literal["rigid", "yaw", "translation", "planar"],
        option("What may move; yaw: a rotation about --up and any shift, planar: none along it."),
    ] = "rigid",
    up: Annotated[tuple[float, float, float], option("The vertical, for yaw and planar.")] = (0.0, 0.0, 1.0),
    scale: Annotated[bool, option("Also estimate one scale factor.", "--scale")] = False,
    max_angle: Annotated[float | None, option("No rotation beyond it, in degrees.", min=0.0)] = None,
    max_shift: Annotated[float | None, option("No shift of the source's centre beyond it.", min=0.0)] = None,
    iterations: Annotated[int, option("Iterations of the solver, at most.", min=1)] = 10,
    robust: Annotated[bool, option("Robust steps on both clouds' Jacobians, or the paper's plain ones.")] = True,
    refine: Annotated[bool, option("Finish with a geometric polish.")] = True,
    model: Annotated[Path | None, option("Encoder weights, .safetensors. [default: the bundled ones]")] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"], option("Where the solver runs; auto: the CPU.")] = "auto",
    seed: Annotated[int, option("The same seed gives the same answer.", min=0)] = 0,
) -> dict[str, Any]:
    """What ``fmr_cli.Options`` takes; a transform file for ``init`` is read. Raises FmrError.

    As a dict, since Options comes with scipy, which should not come before the first look at the files.
    """
    return {
        "init": read_init(init), "voxel_size": voxel_size, "normalize": normalize, "points": points, "dof": dof,
        "up": up, "scale": scale, "max_angle": max_angle, "max_shift": max_shift, "iterations": iterations,
        "robust": robust, "refine": refine, "model": model, "device": device, "seed": seed,
    }  # fmt: skip


def takes_registration_options(command: Callable) -> Callable:
    """Gives a command every option of ``registration_options``; they come to it as one argument, ``options``."""
    shared, own = (inspect.signature(function, eval_str=True) for function in (registration_options, command))

    @functools.wraps(command)
    def run(**given: Any) -> None:
        options = registration_options(**{name: given.pop(name) for name in shared.parameters})
        command(**given, options=options)

    parameters = [p for p in own.parameters.values() if p.name != "options"]
    keyword_only = [p.replace(kind=p.KEYWORD_ONLY) for p in shared.parameters.values()]
    run.__signature__ = own.replace(parameters=[*parameters, *keyword_only])  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in [*parameters, *keyword_only]}
    return run
