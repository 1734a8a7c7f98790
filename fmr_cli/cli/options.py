"""Options that several commands share; those of a registration are made from the fields of ``Options``."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from functools import partial
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fmr_cli.cli.console import say
from fmr_cli.errors import FmrError
from fmr_cli.registration.options import Options, flag, read_init

if TYPE_CHECKING:
    from fmr_cli.workers import Workers

Command = Callable[..., None]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")]
Verbose = Annotated[
    int, typer.Option("--verbose", "-v", count=True, help="Say what was decided and why; -vv says more.")
]
Debug = Annotated[bool, typer.Option("--debug", help="Where an error comes from, as a traceback.")]
PICTURES = (".png", ".pdf", ".svg")
Report = Annotated[Path | None, typer.Option(help="A page that shows the result, one .html that needs no network.")]
BinColumns = Annotated[
    str | None,
    typer.Option(help="What a .bin holds, such as x,y,z,intensity,ring:u2 (float32 without a type)."),
]

Bounds = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(
        metavar="X Y Z X Y Z", help="Only what lies between two corners, low and high; of a COPC nothing else is read."
    ),
]
Resolution = Annotated[
    float | None, typer.Option(help="Of a COPC: the spacing of points that is enough, in the file's unit.")
]
Topic = Annotated[str | None, typer.Option(help="Of a bag: the topic of its point clouds, where it has several.")]
Dask = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", show_default=False,
        help="Work on a Dask cluster: its scheduler's address, tcp://host:8786; or local, which starts one here.",
    ),
]  # fmt: skip


@contextmanager
def chosen_workers(workers: int | None, dask: str | None, quiet: bool) -> Iterator[int | Workers | None]:
    """--workers and --dask as align_batch and align_many take them. Raises FmrError, as where nobody answers."""
    if dask is None:
        yield workers
        return
    if workers and dask != "local":
        raise FmrError("--workers counts processes of this machine, a scheduler has its own: leave one of both out")
    from fmr_cli.workers import DaskWorkers

    with DaskWorkers(dask, workers, partial(say, quiet=quiet)) as team:
        yield team


def check_report(path: Path | None) -> None:
    """Before a long computation: --report can be written. Raises FmrError."""
    if path is not None:
        from fmr_cli.report.page import check_page

        check_page(path)


def check_picture(path: Path | None) -> None:
    """Before a long computation: --picture can be made. Raises FmrError."""
    if path is not None:
        from fmr_cli.report import plots

        plots.check_picture(path)


def check_screen(wanted: bool) -> None:
    """Before a long computation: --view has a screen. Raises FmrError."""
    if wanted:
        from fmr_cli.report import view_window

        view_window.check_screen()


def columns(given: str | None) -> tuple[str, ...] | None:
    """--bin-columns as names. Raises FmrError where x, y and z are not among them, or a name is there twice."""
    if given is None:
        return None
    wanted = tuple(name.strip() for name in given.split(","))
    names = [name.partition(":")[0] for name in wanted]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names) or not all(names):
        raise FmrError(f"--bin-columns {given}: needs x, y and z, each name once, such as x,y,z,intensity,ring:u2")
    return wanted


ALL_OPTIONS = tuple(field.name for field in fields(Options))


def registration_parameter(f: Field[Any]) -> Parameter:
    """A field of Options as a parameter of a command. Options checks its value, so that every message is one line."""
    text = f.metadata["help"]
    names = [flag(f.name)] if f.default is False else []  # what is off by default needs no --no-
    info = typer.Option(*names, help=f"{text[0].upper()}{text[1:]}.", rich_help_panel="Registration")
    kind = str if f.name == "init" else f.type  # a name or a file, see read_init
    return Parameter(f.name, Parameter.KEYWORD_ONLY, default=f.default, annotation=Annotated[kind, info])


def takes_registration_options(command: Command, names: Sequence[str] = ALL_OPTIONS) -> Command:
    """Gives a command the options of a registration, or those named; they come to it as one argument, ``options``."""

    def run(**given: Any) -> None:
        chosen = {name: given.pop(name) for name in names}
        if "init" in chosen:
            chosen["init"] = read_init(chosen["init"])
        command(**given, options=Options(**chosen))

    more = [registration_parameter(f) for f in fields(Options) if f.name in names]
    return with_parameters(command, run, more, without="options")


def takes_debug(command: Command) -> Command:
    """Gives a command --debug, which ``main`` looks for by itself."""

    def run(**given: Any) -> None:
        del given["debug"]
        command(**given)

    return with_parameters(command, run, [Parameter("debug", Parameter.KEYWORD_ONLY, default=False, annotation=Debug)])


def with_parameters(command: Command, run: Command, more: list[Parameter], without: str = "") -> Command:
    """``run`` in the place of ``command``, with its name, its text and its parameters, some more and one less."""
    signature = inspect.signature(command, eval_str=True)
    parameters = [*(p for p in signature.parameters.values() if p.name != without), *more]
    run = functools.wraps(command)(run)
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run
