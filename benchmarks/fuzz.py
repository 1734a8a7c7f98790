"""Malformed files: mutations of small valid ones of every format, read in a process that may crash.

    python -m benchmarks.fuzz --count 4000
    python -m benchmarks.fuzz --minutes 60 --out found/

A file is either read, or refused by a CloudFileError whose one line begins with its path. Anything else is a finding:
another exception, a crash, more than 2 s of the processor or 500 MB, a line on stderr. Findings go to --out.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from benchmarks.corpus import Example, examples, parted_examples
from fmr_cli.errors import CloudFileError
from fmr_cli.io import read_cloud

SECONDS, MEGABYTES = 2.0, 500  # of the processor; of memory beyond what the process has
HANGS = 30.0  # s of the processor after which a process that still reads one file is ended
LARGEST = 1_000_000  # bytes of a malformed file
TEXT = (".xyz", ".txt", ".asc", ".csv", ".pts", ".ptx", ".off", ".obj")
NUMBERS = (0, 1, 2, 3, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)
CELLS = (
    "", "nan", "inf", "-", "1e400", "-0", "1_0", "1,5", "1.5.2", '"', "''", "0x1F", "9" * 400, "1e-400", "\0", "\ufeff",
    "x", "-1", "999999999999", "1D+3", "#", ";", "vertex", "0 0", "\u0665", "4294967296",
)  # fmt: skip


def mutated(example: Example, rng: random.Random) -> bytes:
    """The file with one to four things changed, in the way of its format."""
    data = example.data
    name = example.name.lower()
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if name.endswith(".gz") and rng.random() < 0.6:
            data = gzip.compress(text_mutation(safely(gzip.decompress, data), rng), 1)
        elif name.endswith(".npz") and rng.random() < 0.6:
            data = zip_mutation(data, rng)
        elif name.endswith(TEXT) and rng.random() < 0.8:
            data = text_mutation(data, rng)
        elif name.endswith((".ply", ".pcd")) and rng.random() < 0.6:
            data = header_mutation(data, rng)
        else:
            data = byte_mutation(data, rng)
    if rng.random() < 0.02 and data:  # large ones, of which a quadratic reader shows
        start = rng.randrange(len(data))
        piece = data[start : start + rng.choice((1, 10, 100, 1000))]
        data = data[:start] + piece * ((LARGEST - len(data)) // max(len(piece), 1)) + data[start:]
    return data[:LARGEST]


def safely(function: Callable[[bytes], bytes], data: bytes) -> bytes:
    try:
        return function(data)
    except Exception:
        return data


def byte_mutation(data: bytes, rng: random.Random) -> bytes:
    """Numbers of every size written over, often in the first or the last bytes; bits, pieces, ends."""
    if not data:
        return rng.randbytes(20)
    size = len(data)
    where = rng.random()
    span = (0, min(512, size)) if where < 0.5 else (max(size - 256, 0), size) if where < 0.65 else (0, size)
    at = rng.randrange(*span)
    kind = rng.randrange(8)
    if kind < 3:
        width = rng.choice((1, 2, 4, 8))
        value = rng.choice(NUMBERS) if rng.random() < 0.8 else rng.getrandbits(64)
        order = rng.choice(("little", "big"))
        return data[:at] + (value % (1 << 8 * width)).to_bytes(width, order) + data[at + width :]  # type: ignore[arg-type]
    if kind == 3:
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    if kind == 4:
        return data[:at]
    if kind == 5:
        return data[:at] + data[at + rng.choice((1, 2, 4, 30)) :]
    if kind == 6:
        other = rng.randrange(size)
        return data[:at] + data[other : other + rng.choice((1, 4, 64))] + data[at:]
    return (
        data[:at]
        + struct.pack("<d", rng.choice((0.0, 1e300, -1e308, 5e-324, float("nan"), float("inf"))))
        + data[at + 8 :]
    )


def text_mutation(data: bytes, rng: random.Random) -> bytes:
    """Cells, lines and separators changed."""
    text = data.decode("latin-1")
    lines = text.splitlines(keepends=True) or [""]
    at = min(int(rng.expovariate(0.2)), len(lines) - 1) if rng.random() < 0.6 else rng.randrange(len(lines))
    kind = rng.randrange(7)
    if kind < 3:
        separator = next((s for s in ",;\t|" if s in lines[at]), " ")
        cells = lines[at].split(separator)
        cells[rng.randrange(len(cells))] = rng.choice(CELLS)
        lines[at] = separator.join(cells)
    elif kind == 3:
        lines.insert(at, rng.choice(lines))
    elif kind == 4:
        del lines[at : at + rng.choice((1, 1, 5))]
    elif kind == 5:
        lines[at] = lines[at].replace(rng.choice(" ,;\n.\t"), rng.choice((" ", ",", ";", "\t", "", '"', "\r")))
    else:
        lines[at] = rng.choice(CELLS) + rng.choice(("", "\n", " " * 100)) + lines[at]
    return "".join(lines).encode("latin-1", "replace")


def header_mutation(data: bytes, rng: random.Random) -> bytes:
    """A word of a text header changed, or a line of it; what stands behind stays."""
    ends = [data.find(mark) for mark in (b"end_header", b"DATA", b"data")]
    end = next((e for e in ends if e > 0), len(data))
    lines = data[:end].decode("latin-1").split("\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(" ")
    kind = rng.randrange(4)
    if kind == 0:
        words[rng.randrange(len(words))] = rng.choice((*CELLS, *map(str, NUMBERS), "list", "double", "uchar", "x", "y"))
        lines[at] = " ".join(words)
    elif kind == 1:
        lines.insert(at, rng.choice(lines))
    elif kind == 2:
        del lines[at]
    else:
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        lines[i], lines[j] = lines[j], lines[i]
    return "\n".join(lines).encode("latin-1", "replace") + data[end:]


def zip_mutation(data: bytes, rng: random.Random) -> bytes:
    """One of the arrays of an NPZ changed, and packed again."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
    except Exception:
        return byte_mutation(data, rng)
    chosen = rng.choice([*entries, ""])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), byte_mutation(content, rng) if name == chosen else content)
    return out.getvalue()


def said_wrong(path: Path) -> str | None:
    """What is wrong with how a file is read, or None."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    found = None
    try:
        read_cloud(path, mesh_points=1000, at_most=30 if ".copc" in path.name else None)
    except CloudFileError as error:
        text = str(error)
        if not text.startswith(str(path)) or "\n" in text or len(text) > len(str(path)) + 600:
            found = f"message {text[:200]!r}"
        elif "Error" in text and "CloudFileError" in text:
            found = f"an exception's name in {text[:200]!r}"
    except BaseException as error:  # a PanicException is no Exception
        found = f"{type(error).__name__}: {error}"[:300]
    seconds = time.process_time() - begin
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    if found is None and seconds > SECONDS:
        found = f"{seconds:.1f} s"
    if found is None and grown > MEGABYTES:
        found = f"{grown:.0f} MB"
    return found


class Stderr:
    """All that the process writes to stderr, native libraries too, since the last look."""

    def __init__(self, folder: Path) -> None:
        self.file = (folder / "stderr").open("w+b")
        self.seen = 0
        os.dup2(self.file.fileno(), 2)

    def news(self) -> str:
        sys.stderr.flush()
        size = os.fstat(self.file.fileno()).st_size
        text = os.pread(self.file.fileno(), size - self.seen, self.seen).decode(errors="replace")
        self.seen = size
        return text


def work(seed: int, count: int, minutes: float | None, folder: Path) -> None:
    """The process that may crash: mutations in turn; each is a file in ``folder`` while it is read."""
    corpus = [*examples(), *parted_examples()]
    done: Counter[str] = Counter()
    end = None if minutes is None else time.monotonic() + 60 * minutes
    number = seed
    errors = Stderr(folder)
    while (number < seed + count) if end is None else (time.monotonic() < end):
        rng = random.Random(number)
        example = corpus[number % len(corpus)]
        data = mutated(example, rng)
        path = folder / f"{number}-{example.name}"
        path.write_bytes(data)
        (folder / "last").write_text(path.name)
        signal.setitimer(signal.ITIMER_PROF, HANGS)  # ends the process by SIGPROF, whatever it is in
        wrong = said_wrong(path)
        if (news := errors.news()) and wrong is None:
            wrong = f"on stderr: {news[:300]!r}"
        if wrong is not None:
            print(json.dumps({"file": path.name, "wrong": wrong, "of": hashlib.sha1(data).hexdigest()}), flush=True)
        else:
            path.unlink()
        done[example.row] += 1
        number += 1
    print(json.dumps({"executions": done.total(), "rows": done}), flush=True)


def run(seed: int, count: int, minutes: float | None, folder: Path) -> tuple[int, list[dict[str, str]]]:
    """How many files were read, and the findings; goes on after a crash."""
    findings: list[dict[str, str]] = []
    total = 0
    begin = time.monotonic()
    while count > 0 or minutes is not None:
        left = None if minutes is None else minutes - (time.monotonic() - begin) / 60
        if left is not None and left <= 0:
            break
        arguments = ["--work", str(folder), "--seed", str(seed), "--count", str(count)]
        arguments += [] if left is None else ["--minutes", f"{left:.4f}"]
        process = subprocess.run(
            [sys.executable, "-m", "benchmarks.fuzz", *arguments], capture_output=True, text=True, check=False
        )
        rows = [json.loads(line) for line in process.stdout.splitlines()]
        findings += [row for row in rows if "wrong" in row]
        if process.returncode == 0:
            return total + rows[-1]["executions"], findings
        last = (folder / "last").read_text() if (folder / "last").exists() else ""
        hung = process.returncode == -signal.SIGPROF
        how = f"more than {HANGS:.0f} s" if hung else f"the process ended with {process.returncode}"
        findings.append({"file": last, "wrong": how})
        after = int(last.split("-")[0]) + 1 if last else seed + count
        total, count, seed = total + after - seed, count - (after - seed), after
    return total, findings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=4000)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.seed, given.count, given.minutes, given.work)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.out or Path(temporary)
        folder.mkdir(exist_ok=True)
        total, findings = run(given.seed, given.count, given.minutes, folder)
    for finding in findings:
        print(f"{finding['file']}: {finding['wrong']}")
    rows = {example.row for example in (*examples(), *parted_examples())}
    print(f"{total} files of {len(rows)} dialects, {len(findings)} findings")
    sys.exit(1 if findings else 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
