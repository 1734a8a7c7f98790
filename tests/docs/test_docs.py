"""The documentation: it builds without a warning, its links lead somewhere, its examples run, its options are there."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import command
import pytest
from typer.main import get_command

from fmr_cli.cli.app import app

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
SHOWN = [ROOT / "README.md", *PAGES]


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec
    assert spec.loader
    made = importlib.util.module_from_spec(spec)
    sys.modules[name] = made  # dataclasses look themselves up there
    spec.loader.exec_module(made)
    return made


examples = module("examples")
WITH_EXAMPLES = [page for page in SHOWN if examples.examples(page.read_text("utf-8"))]
FIRST = "README.md"  # its examples run with the quick tests, those of the other pages take minutes


@pytest.mark.slow
def test_it_builds_and_every_link_and_anchor_leads_somewhere(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    reference = (tmp_path / "site/reference/commands.html").read_text("utf-8")
    for name, described in get_command(app).commands.items():  # type: ignore[attr-defined]
        assert f"fmr {name}</h2>" in reference or f'id="fmr-{name}"' in reference
        for option in described.params:
            for flag in option.opts if option.param_type_name == "option" else ():
                assert flag in reference, f"{name} {flag}"
    method = (tmp_path / "site/method/index.html").read_text("utf-8")
    assert method.count("<math") > 20
    assert "arithmatex" not in method, "an equation is not shown"


@pytest.mark.parametrize("page", [
    pytest.param(page, id=str(page.relative_to(ROOT)), marks=() if page.name == FIRST else pytest.mark.slow)
    for page in WITH_EXAMPLES
])  # fmt: skip
def test_the_examples_run(page: Path) -> None:
    """Those of the first page as a shell runs them, each command a process."""
    examples.run_page(page, here=None if page.name == FIRST else within)


def within(arguments: list[str]) -> tuple[int, str]:
    """`fmr` within this process: its exit code, and what it says."""
    done = command.here(*arguments, cwd=Path.cwd())
    return done.returncode, done.stdout + done.stderr


def test_an_example_that_does_not_run_is_told(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("```bash\nfmr align none.ply none.ply\n```\n")
    with pytest.raises(AssertionError, match="ends with 2"):
        examples.run_page(tmp_path / "page.md")


def test_outputs_are_written_where_they_are_shown(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(6 * 7)\n```\n\n```text\n```\n\n```python\nprint(1)\n```\n")
    examples.update(page)
    assert page.read_text() == "```python\nprint(6 * 7)\n```\n\n```text\n42\n```\n\n```python\nprint(1)\n```\n"


@pytest.mark.parametrize("page", SHOWN, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_options_that_are_spoken_of_are_there(page: Path) -> None:
    """Wherever `fmr COMMAND ... --option` stands, in a block or in a sentence."""
    commands = get_command(app).commands  # type: ignore[attr-defined]
    everywhere = {"--help", "--version", "--debug", "--install-completion"}
    for line in re.findall(r"\bfmr ([a-z]+)([^`|\n]*)", page.read_text("utf-8")):
        name, rest = line
        if name not in commands:
            continue
        known = {flag for p in commands[name].params for flag in (*p.opts, *p.secondary_opts)} | everywhere
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", rest):
            assert flag in known, f"{page}: fmr {name} has no {flag}"


def test_every_extra_is_on_the_page_of_installation() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    page = (ROOT / "docs" / "install.md").read_text("utf-8")
    assert [extra for extra in extras if f"'.[{extra}]'" not in page] == []


@pytest.mark.parametrize("page", [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "ARCHITECTURE.md")])
def test_links_of_the_pages_at_the_top(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
        if not target.startswith(("http", "mailto")):
            assert (page.parent / target).exists(), f"{page.name}: {target} is not there"
