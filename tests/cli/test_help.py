from __future__ import annotations

import subprocess
import sys

import fmr_cli


def test_help_names_the_commands(fmr):
    done = fmr("--help")
    assert done.returncode == 0
    assert {"align", "batch"} <= set(done.stdout.split())


def test_version(fmr):
    assert fmr("--version").stdout.strip() == fmr_cli.__version__


def test_help_imports_nothing_heavy():
    code = (
        "import sys, runpy; sys.argv = ['fmr', '--help']\n"
        "try: runpy.run_module('fmr_cli.cli', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'scipy', 'laspy', 'small_gicp') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]", "the start of every command waits for these"


def test_the_options_defaults_are_the_librarys():
    from fmr_cli.cli.options import registration_options
    from fmr_cli.registration.options import Options

    assert Options(**registration_options()) == Options()


def test_an_unknown_option_is_bad_input(fmr):
    done = fmr("align", "a.ply", "b.ply", "--sideways")
    assert done.returncode == 2
    assert "--sideways" in done.stderr
