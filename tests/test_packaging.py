"""What is in the wheel: the package with its weights, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def names(tmp_path_factory) -> set[str]:
    """The names in a wheel built, without a network, from a copy of the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("fmr_cli", "models"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", "dist", "."]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = (folder / "dist").glob("*.whl")
    return set(zipfile.ZipFile(wheel).namelist())


def test_the_wheel_holds_every_weight_card_and_recipe(names):
    bundled = {path.name for path in (ROOT / "models").iterdir() if path.suffix in (".safetensors", ".md", ".toml")}
    assert {"base.safetensors", "base.toml", "local.safetensors"} <= bundled
    assert any(name.endswith(".md") for name in bundled)
    assert {f"fmr_cli/models/{name}" for name in bundled} <= names


def test_the_wheel_holds_every_module(names):
    assert {path.relative_to(ROOT).as_posix() for path in (ROOT / "fmr_cli").rglob("*.py")} <= names


def test_the_wheel_holds_what_pages_are_made_of(names):
    made_of = {path.relative_to(ROOT).as_posix() for path in (ROOT / "fmr_cli/report/templates").iterdir()}
    assert {"fmr_cli/report/templates/base.html", "fmr_cli/report/templates/common.js"} <= made_of <= names


def test_the_wheel_installs_one_package(names):
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"fmr_cli"}
