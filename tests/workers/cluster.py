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

    host, prefix: where the scheduler listens, and a command that runs it. more: variables of their environment.
    """

    def __init__(
        self, folder: Path, protocol: str = "tcp", host: str = "127.0.0.1", prefix: tuple[str, ...] = (), **more: str
    ) -> None:
        self.folder, self.processes, self.more = folder, [], more
        self.scheduler = self.start(
            "from distributed.cli.dask_scheduler import main", "--port", 0, "--scheduler-file",
            folder / "scheduler.json", "--no-dashboard", "--host", host, "--protocol", protocol,
            prefix=prefix,
        )  # fmt: skip
        wait_for(lambda: (folder / "scheduler.json").exists() and (folder / "scheduler.json").read_text().endswith("}"))
        self.address = json.loads((folder / "scheduler.json").read_text())["address"]

    def worker(self, first: str = "", prefix: tuple[str, ...] = (), more: tuple[str, ...] = ()) -> subprocess.Popen:
        """A worker of one thread. first: what its Python does before; prefix: what runs it; more: arguments."""
        return self.start(
            f"{first}\nfrom distributed.cli.dask_worker import main", self.address, "--nthreads", 1, "--no-nanny",
            "--no-dashboard", "--memory-limit", 0, "--local-directory", self.folder, *more, prefix=prefix,
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
    by = ("-CA", "ca.pem", "-CAkey", "ca-key.pem", "-CAcreateserial")
    openssl("x509", "-req", "-in", "node.csr", *by, "-out", "node.pem")


class Network:
    """A hub and so many machines, as far as the network can tell: each a namespace, a cable from each to the hub.

    A context; raises NotAllowedError where this machine, or who runs the tests, cannot have it.
    """

    hub_address = "10.77.0.1"

    def __init__(self, machines: int) -> None:
        self.names = [f"fmr-{os.getpid()}-{number}" for number in range(machines + 1)]  # the first is the hub

    def on(self, machine: int) -> tuple[str, ...]:
        """What runs a command on a machine, 0 is the hub."""
        return ("ip", "netns", "exec", self.names[machine])

    def address(self, machine: int) -> str:
        return f"10.77.{machine}.2"

    def pull(self, machine: int) -> None:
        """The cable out of the hub: no word comes through any more, and nobody is told."""
        ip("-n", self.names[0], "link", "set", f"hub{machine}", "down")

    def __enter__(self) -> Network:
        try:
            hub = self.names[0]
            for number, name in enumerate(self.names):
                ip("netns", "add", name)
                ip("-n", name, "link", "set", "lo", "up")
                if number == 0:
                    ip("-n", hub, "addr", "add", f"{self.hub_address}/32", "dev", "lo")
                    continue
                ip("link", "add", f"hub{number}", "netns", hub, "type", "veth", "peer", "name", "cable", "netns", name)
                for where, end, last in ((hub, f"hub{number}", 1), (name, "cable", 2)):
                    ip("-n", where, "addr", "add", f"10.77.{number}.{last}/30", "dev", end)
                    ip("-n", where, "link", "set", end, "up")
                ip("-n", name, "route", "add", "default", "via", f"10.77.{number}.1")
        except (OSError, subprocess.CalledProcessError) as error:
            self.__exit__()
            raise NotAllowedError(str(error)) from None
        return self

    def __exit__(self, *_: object) -> None:
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


class NotAllowedError(Exception):
    """Network namespaces cannot be made here."""


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def wait_for(condition, seconds: float = 120.0) -> None:
    """Until a condition holds; an AssertionError after so long."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def stop(process: subprocess.Popen) -> None:
    os.kill(process.pid, signal.SIGSTOP)
