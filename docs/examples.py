"""Runs the examples of the documentation, and writes what they print into it.

    python docs/examples.py docs/tutorials/two-scans.md            # do they run?
    python docs/examples.py --update docs/tutorials/*.md           # put their output into the text blocks after them

Of a page, the blocks ``bash`` and ``python`` run in order in one fresh folder, a ``bash`` block line by line; blocks of
other kinds are only shown. A block ``text`` right after one that runs is its output. Comments before a
block, not shown on the page:

    <!-- in tests: --scans 20 -> --scans 4 -->    what the tests run in its place, to be quick
    <!-- exit: 3 -->                              it ends with this code (uncertain)
    <!-- not run: needs a cluster -->             it is only shown
"""

from __future__ import annotations

import argparse
import contextlib
import glob
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BLOCK = re.compile(
    r"(?P<said>(?:<!-- (?:in tests|exit|not run): .*? -->\n)*)```(?P<kind>bash|python)\n(?P<code>.*?)```\n"
    r"(?:\n```text\n(?P<output>.*?)```\n)?",
    re.DOTALL,
)


PLAIN = re.compile(r"fmr [^|&;<>$`(\\]*")  # a line with nothing for a shell to do, but for names with *
Here = Callable[[list[str]], tuple[int, str]]  # arguments of fmr to its exit code and what it says

SECONDS = re.compile(r"\b\d+\.\d\d s\b")  # differ with the machine and what else it does


@dataclass(frozen=True)
class Example:
    """One block. code: as on the page; quick: as the tests run it; exit: the code it ends with; shown: its output."""

    kind: str
    code: str
    quick: str
    exit: int
    shown: str | None


def examples(text: str) -> list[Example]:
    found = []
    for block in BLOCK.finditer(text):
        if "<!-- not run: " in block["said"]:
            continue
        quick = block["code"]
        for old, new in re.findall(r"<!-- in tests: (.*?) -> (.*?) -->", block["said"]):
            if old not in quick:
                raise ValueError(f"no {old!r} in {quick!r}")
            quick = quick.replace(old, new)
        code = re.search(r"<!-- exit: (\d+) -->", block["said"])
        found.append(Example(block["kind"], block["code"], quick, int(code[1]) if code else 0, block["output"]))
    return found


def run_page(page: Path, quick: bool = True, here: Here | None = None) -> list[str]:
    """What each block of a page prints. Raises AssertionError where one does not end as it says.

    here: runs `fmr` within this process where a line is nothing else: to start one takes longer than most of them do.
    """
    printed, namespace = [], dict[str, Any]()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for example in examples(page.read_text("utf-8")):
            code = example.quick if quick else example.code
            printed.append(
                run_bash(code, example.exit, here) if example.kind == "bash" else run_python(code, namespace)
            )
    return printed


def run_bash(code: str, expected: int, here: Here | None = None) -> str:
    printed = ""
    for line in code.splitlines():
        if here and PLAIN.fullmatch(line):
            ended, said = here([name for word in shlex.split(line, comments=True)[1:] for name in names(word)])
        else:
            ended, said = run_line(line)
        printed += said
        if ended:
            break
    assert ended == expected, f"{code}\nends with {ended}, not {expected}:\n{printed}"
    return printed


def names(word: str) -> list[str]:
    """The files that a word with * stands for; the word itself where there are none."""
    return sorted(glob.glob(word)) or [word]


def run_line(line: str) -> tuple[int, str]:
    script = f'fmr() {{ "{sys.executable}" -m fmr_cli.cli "$@"; }}\n{line}'
    environment = {**os.environ, "COLUMNS": "120", "NO_COLOR": "1", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(["bash", "-c", script], env=environment, text=True, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, timeout=900)  # fmt: skip
    return done.returncode, done.stdout


def run_python(code: str, namespace: dict[str, Any]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code, "<example>", "exec"), namespace)
    return out.getvalue()


def update(page: Path) -> None:
    """Writes the output of each block that shows one into the page."""
    text, printed = page.read_text("utf-8"), iter(run_page(page, quick=False))

    def filled(block: re.Match[str]) -> str:
        if "<!-- not run: " in block["said"]:
            return block[0]
        output = next(printed)
        if block["output"] is None:
            return block[0]
        start = block.start("output") - block.start()
        lines = "\n".join(SECONDS.sub("... s", line.rstrip()) for line in output.splitlines())
        return f"{block[0][:start]}{lines}\n```\n"

    page.write_text(BLOCK.sub(filled, text), "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--update", action="store_true", help="write the output into the pages")
    args = parser.parse_args()
    for page in args.pages:
        print(page, file=sys.stderr)
        if args.update:
            update(page.resolve())
        else:
            run_page(page.resolve())


if __name__ == "__main__":
    main()
