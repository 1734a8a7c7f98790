from __future__ import annotations

import subprocess
import sys

import pytest

import fmr_cli


def test_help_names_the_commands(fmr_process):
    done = fmr_process("--help")
    assert done.returncode == 0
    assert {"align", "batch", "multiway", "sequence", "info", "transform", "train", "evaluate"} <= set(
        done.stdout.split()
    )


def test_version(fmr_process):
    assert fmr_process("--version").stdout.strip() == fmr_cli.__version__


@pytest.mark.parametrize("arguments", [("--help",), ("align", "--help"), ("align", "--sideways")])
def test_what_only_looks_at_the_arguments_imports_nothing_heavy(arguments):
    code = (
        f"import sys, runpy; sys.argv = ['fmr', *{arguments}]\n"
        "try: runpy.run_module('fmr_cli.cli', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'scipy', 'laspy', 'small_gicp') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]", "the start of every command waits for these"


def test_completion_of_the_shell_can_be_installed(fmr):
    assert "--install-completion" in fmr("--help").stdout


def test_an_unknown_option_is_bad_input(fmr):
    done = fmr("align", "a.ply", "b.ply", "--sideways")
    assert done.returncode == 2
    assert "--sideways" in done.stderr
