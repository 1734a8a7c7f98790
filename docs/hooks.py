"""What mkdocs does not do by itself: the command reference from the commands, quoted figures, equations as MathML."""

from __future__ import annotations

import csv
import html
import itertools
import re
from pathlib import Path
from typing import Any, get_args

from latex2mathml.converter import convert
from typer.main import get_command

from fmr_cli.cli.app import app
from fmr_cli.evaluation.quoted import QUOTED

ROOT = Path(__file__).parents[1]
RESULTS = [ROOT / "docs" / "results" / name for name in ("paper.csv", "last-step.csv")]
MATH = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fills in what is made from the code: ``<!-- commands -->``, ``<!-- experiment: noise -->``, ..."""
    markdown = markdown.replace("```text\n```\n", "")  # an output that has not been filled in
    markdown = markdown.replace("<!-- commands -->", commands())
    markdown = re.sub(r"<!-- experiment: (.*?) -->", lambda found: experiment(found[1]), markdown)
    markdown = markdown.replace("<!-- calibration -->", calibration())
    return re.sub(r"<!-- quoted: (.*?) -->", lambda found: quoted(found[1]), markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Equations as MathML, which browsers show without a script."""

    def mathml(found: re.Match[str]) -> str:
        return convert(html.unescape(found[2]).strip(), display="block" if found[1] == "div" else "inline")

    return MATH.sub(mathml, content)


def commands() -> str:
    """A section for each command: what it is for, its arguments, its options by their groups."""
    group = get_command(app)
    return "\n\n".join(section(name, command) for name, command in group.commands.items())  # type: ignore[attr-defined]


def section(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option"]
    usage = " ".join([f"fmr {name}", *(shown(argument) for argument in arguments), "[OPTIONS]"])
    parts = [f"## fmr {name}", f"```text\n{usage}\n```", inspected(command.help)]
    if arguments:
        parts.append(
            "\n".join(["| argument | |", "| --- | --- |", *(row(f"`{a.name.upper()}`", a) for a in arguments)])
        )
    groups: dict[str, list[Any]] = {}
    for option in options:
        groups.setdefault(getattr(option, "rich_help_panel", None) or "Options", []).append(option)
    for title, members in groups.items():
        head = [f"| {'option' if title == 'Options' else title.lower()} | | default |", "| --- | --- | --- |"]
        parts.append("\n".join([*head, *(row(names(o), o, default(o)) for o in members)]))
    return "\n\n".join(parts)


def shown(argument: Any) -> str:
    name = argument.name.upper() + ("..." if argument.nargs == -1 else "")
    return name if argument.required else f"[{name}]"


def inspected(text: str) -> str:
    """A command's docstring as Markdown paragraphs."""
    return "\n".join(line.strip() for line in (text or "").strip().splitlines())


def names(option: Any) -> str:
    """`-o`, `--out PATH`."""
    flags = [*option.opts, *option.secondary_opts]
    if not option.is_flag and not getattr(option, "count", False):
        flags[-1] += " " + (option.metavar or kind(option.type_descriptor.annotation))
    return ", ".join(f"`{flag}`" for flag in flags)


def kind(annotation: Any) -> str:
    """What an option takes, in a word: NUMBER, PATH, one/two."""
    parts = [part for part in get_args(annotation) if part is not type(None)]
    if parts and all(isinstance(part, str) for part in parts):
        return "/".join(parts)
    if parts:  # of an optional, a list, three numbers
        return " ".join(kind(part) for part in parts)
    return {int: "NUMBER", float: "NUMBER", str: "TEXT", Path: "PATH"}.get(annotation, "VALUE")


def default(option: Any) -> str:
    if option.required:
        return "required"
    if isinstance(option.show_default, str):
        return option.show_default
    value = option.default
    if option.show_default is False or option.count or value is None or value is False or callable(value):
        return ""
    if value is True:
        return "yes"
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def row(name: str, parameter: Any, *more: str) -> str:
    help_ = " ".join((parameter.help or "").split()).replace("|", "\\|")
    return "| " + " | ".join([name.replace("|", "\\|"), help_, *(text.replace("|", "\\|") for text in more)]) + " |"


def quoted(dataset: str) -> str:
    """What others published on a data set, with where it stands."""
    lines = ["| method | recall % | RRE deg | RTE m | quoted from |", "| --- | --- | --- | --- | --- |"]
    for q in (q for q in QUOTED if q.dataset == dataset):
        figures = ["" if value is None else f"{value:g}" for value in (q.recall, q.rre, q.rte)]
        lines.append(f"| {q.method} | {' | '.join(figures)} | {q.source} |")
    return "\n".join(lines)


def experiment(name: str) -> str:
    """One experiment, from the results.csv of `fmr evaluate` beside the page: methods, of each set, by level."""
    rows = []
    for path in RESULTS:
        with path.open(newline="", encoding="utf-8") as file:
            rows += [row for row in csv.DictReader(file) if row["experiment"] == name]
    levels, several = list(dict.fromkeys(row["level"] for row in rows)), len({row["clouds"] for row in rows}) > 1
    lines = [f"| | {' | '.join(f'{float(level):g}' for level in levels)} |", "| --- " * (len(levels) + 1) + "|"]
    for clouds, method in dict.fromkeys((row["clouds"], row["method"]) for row in rows):
        own = {row["level"]: row for row in rows if (row["clouds"], row["method"]) == (clouds, method)}
        said = f"{method}, {clouds}" if several else method
        lines.append(f"| {said} | {' | '.join(cell(own[x]) for x in levels)} |")
    return "\n".join(lines)


def cell(row: dict[str, str]) -> str:
    """What the page shows of a row: a share and an error, or the error and how many times the limit it is."""
    if row.get("aligned_right"):
        shares = f"{float(row['aligned_right']):.2f} / {float(row['aligned_wrong']):.2f}"
        scale = round(100 * float(row["scale_median"]), 6)  # a known one is off by rounding alone
        return f"{float(row['success']):.2f} ({shares}; {scale:.2g} %)"
    if row["experiment"].startswith("refine"):
        times = f" ({float(row['limit_ratio']):.1f})" if row["limit_ratio"] else ""
        return f"{float(row['rotation_median']):.3f}{times}"
    return f"{float(row['success']):.2f} ({float(row['rotation_mean']):.1f})"


def calibration() -> str:
    """The table of the verdict's card: how often poses of each confidence were right."""
    lines = (ROOT / "models" / "README.md").read_text("utf-8").splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("| confidence |"))
    return "\n".join(itertools.takewhile(lambda line: line.startswith("|"), lines[first:]))
