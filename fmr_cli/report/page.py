"""A report as one HTML file that needs no network: a template, its data, plotly.js and our own scripts in one page.

Every text goes through Jinja2's escaping, and the data as JSON without ``<``, so that a cloud called ``<script>`` is
only a name. The page's own content security policy forbids it to fetch anything.
"""

from __future__ import annotations

import importlib.util
import math
from datetime import datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import fmr_cli
from fmr_cli.errors import FmrError
from fmr_cli.io.files import atomic_write
from fmr_cli.io.outputs import check_outputs

NEEDED = {"jinja2": "Jinja2", "plotly": "plotly", "PIL": "pillow"}  # module -> package
STATUS = {  # of a pair, a link, a scan, a frame: a class for the colour, and a shape for those who see none
    "aligned": ("good", "✔"), "placed": ("good", "✔"), "known": ("good", "✔"), "right": ("good", "✔"),
    "uncertain": ("doubtful", "▲"), "unplaced": ("doubtful", "▲"), "wrong": ("bad", "✖"), "rejected": ("bad", "✖"),
    "failed": ("bad", "✖"),
}  # fmt: skip


def check_page(path: Path) -> None:
    """Before a long computation: the file can be written and what makes it is installed. Raises FmrError."""
    check_outputs([(path, (".html", ".htm"))])
    missing = [package for module, package in NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        raise FmrError(f"{path}: reports need {', '.join(missing)}; pip install 'fmr-cli[report]'")


def write_page(path: Path, template: str, data: dict[str, Any], scripts: tuple[str, ...], **said: Any) -> None:
    """Render ``template`` to ``path``. data: plain JSON types, for the scripts; said: for the template.

    scripts: names of files in templates/, run in this order after plotly.js and common.js.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    jinja = Environment(
        loader=PackageLoader("fmr_cli.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    jinja.filters["number"] = number
    jinja.globals["status_look"] = lambda status: STATUS.get(status, ("doubtful", "▲"))
    code = [Markup(text) for text in (plotly_js(), *map(own, ("common.js", *scripts)))]
    page = jinja.get_template(template).render(
        data=data, code=code, style=Markup(own("report.css")), version=fmr_cli.__version__,
        made=datetime.now().strftime("%Y-%m-%d %H:%M"), **said,
    )  # fmt: skip
    with atomic_write(path) as temporary:
        temporary.write_text(page, "utf-8")


def own(name: str) -> str:
    return (files("fmr_cli.report") / "templates" / name).read_text("utf-8")


@cache
def plotly_js() -> str:
    """The library as the plotly package brings it, read without importing that package."""
    spec = importlib.util.find_spec("plotly")
    assert spec is not None
    assert spec.submodule_search_locations
    return (Path(spec.submodule_search_locations[0]) / "package_data" / "plotly.min.js").read_text("utf-8")


def number(value: Any, digits: int = 4) -> str:
    """A number for a table; what is not there or not finite as a dash."""
    if value is None or value == "" or (isinstance(value, float) and not math.isfinite(value)):
        return "\u2013"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)
