"""A Dask cluster of real processes on this machine, for tests."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

TESTS = Path(__file__).parents[1]
QUIET = {"DASK_DISTRIBUTED__WORKER__DAEMON": "False", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class Cluster:
    """A scheduler and its workers, each a process of its own. A context that ends them all.

    more: variables of their environment.
    """

    def __init__(self, folder: Path, protocol: str = "tcp", **more: str) -> None:
        self.folder, self.processes, self.more = folder, [], more
        self.scheduler = self.start(
            "from distributed.cli.dask_scheduler import main", "--port", 0, "--scheduler-file",
            folder / "scheduler.json", "--no-dashboard", "--host", "127.0.0.1", "--protocol", protocol,
        )  # fmt: skip
        wait_for(lambda: (folder / "scheduler.json").exists() and (folder / "scheduler.json").read_text().endswith("}"))
        self.address = json.loads((folder / "scheduler.json").read_text())["address"]

    def worker(self, first: str = "", prefix: tuple[str, ...] = ()) -> subprocess.Popen:
        """A worker of one thread. first: what its Python does before; prefix: a command that runs it."""
        return self.start(
            f"{first}\nfrom distributed.cli.dask_worker import main", self.address, "--nthreads", 1, "--no-nanny",
            "--no-dashboard", "--memory-limit", 0, "--local-directory", self.folder, prefix=prefix,
        )  # fmt: skip

    def start(self, code: str, *arguments: object, prefix: tuple[str, ...] = ()) -> subprocess.Popen:
        path = os.pathsep.join([str(TESTS), *filter(None, sys.path)])
        command = [*prefix, sys.executable, "-c", f"import sys; sys.argv[0] = 'dask'\n{code}\nmain()"]
        process = subprocess.Popen(
            [*command, *map(str, arguments)], env={**os.environ, **QUIET, **self.more, "PYTHONPATH": path},
            stdout=subprocess.DEVNULL, stderr=(self.folder / "log.txt").open("a"),
        )  # fmt: skip
        self.processes.append(process)
        return process

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()


def certificates(folder: Path) -> None:
    """By openssl: ca.pem, one that it has signed (node.pem, node-key.pem), and one that is signed by nobody else."""

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    new = ("-newkey", "rsa:2048", "-nodes", "-subj")
    for name in ("ca", "stranger"):
        openssl("req", "-x509", *new, f"/CN={name}", "-keyout", f"{name}-key.pem", "-out", f"{name}.pem")
    openssl("req", *new, "/CN=node", "-keyout", "node-key.pem", "-out", "node.csr")
    openssl(
        "x509",
        "-req",
        "-in",
        "node.csr",
        "-CA",
        "ca.pem",
        "-CAkey",
        "ca-key.pem",
        "-CAcreateserial",
        "-out",
        "node.pem",
    )


def wait_for(condition, seconds: float = 120.0) -> None:
    """Until a condition holds; an AssertionError after so long."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def stop(process: subprocess.Popen) -> None:
    os.kill(process.pid, signal.SIGSTOP)
