"""`fmr view`: clouds in a window, as a picture, or as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from fmr_cli.cli.console import busy, say
from fmr_cli.cli.options import check_report

Coloring = Literal["file", "height", "intensity", "rgb", "residual"]


def view_command(
    files: Annotated[list[Path] | None, typer.Argument(help="Clouds, in one frame.", show_default=False)] = None,
    transform: Annotated[
        Path | None, typer.Option(help="Moves the first file, as `fmr align` writes it.", show_default=False)
    ] = None,
    result: Annotated[
        Path | None,
        typer.Option(help="The --out of `fmr multiway` (its scans) or `fmr batch` (one pair).", show_default=False),
    ] = None,
    color: Annotated[Coloring, typer.Option(help="What gives points their colour.")] = "file",
    point_size: Annotated[float, typer.Option(help="In pixels.", min=0.5, max=20.0)] = 2.0,
    section: Annotated[
        str | None, typer.Option(help="A slice alone: z, z=1.5, or z=1.5:0.1 (so thick).", show_default=False)
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="A picture (.png, .jpg) in place of the window.", show_default=False)
    ] = None,
    html: Annotated[
        Path | None, typer.Option(help="A page that needs no network in place of the window.", show_default=False)
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No notes.")] = False,
) -> None:
    """Look at clouds: turn them, colour them, cut them.

    In the window, 1 to 5 colour by file, height, intensity, RGB, residual; X, Y, Z cut (again: all), [ and ] move the
    cut; + and - change the points; R looks at all; Q closes.
    """
    from fmr_cli.io.outputs import check_outputs

    check_outputs([(screenshot, (".png", ".jpg")), (html, (".html", ".htm"))])
    check_report(html)
    show(files or [], transform, result, color, point_size, section, screenshot, html, quiet)


def show(
    files: list[Path], transform: Path | None, result: Path | None, color: Coloring, size: float, section: str | None,
    screenshot: Path | None, html: Path | None, quiet: bool,
) -> None:  # fmt: skip
    """The clouds of ``fmr view`` in the ways asked for."""
    from fmr_cli.report.coloring import missing, with_residuals
    from fmr_cli.report.view_clouds import load, read_section
    from fmr_cli.report.view_page import ON_PAGE, write_view
    from fmr_cli.report.view_window import IN_WINDOW, Window

    with busy("reading", quiet):
        clouds, notes = load(files, transform, result, IN_WINDOW if screenshot or not html else ON_PAGE)
        if len(clouds) > 1:
            clouds = with_residuals(clouds)
        cut = read_section(section, clouds)
    say(*notes, *missing(clouds, color), quiet=quiet)
    if html:
        write_view(html, clouds, color, size, cut)
    if screenshot:
        Window(clouds, color, size, cut).save(screenshot)
    if not html and not screenshot:
        Window(clouds, color, size, cut).run()
