"""Workers on machines of their own, as far as the network can tell: one is killed, one stopped, one cut off."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("distributed")

from workers.cluster import QUIET, Cluster, Network, NotAllowedError, stop, wait_for

from fmr_cli import read_cloud, write_cloud

SAMPLES = Path(__file__).parents[2] / "samples"
IMPATIENT = (
    "from fmr_cli.workers import handing; handing.PATIENCE, handing.SLOWER = 5.0, 1.5\n"
    "from fmr_cli.cli.app import main; main()"
)


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    """The scheduler and the command on the hub, three workers on a machine each."""
    try:
        with Network(3) as network:
            folder = tmp_path_factory.mktemp("network")
            with Cluster(folder, host=network.hub_address, prefix=network.on(0)) as cluster:
                yield network, cluster
    except NotAllowedError as error:
        pytest.skip(f"network namespaces need root and iproute2 ({error})")


def worker_on(machine: int, network: Network, cluster: Cluster) -> subprocess.Popen:
    return cluster.worker(prefix=network.on(machine), more=("--host", network.address(machine)))


def command(prefix: tuple[str, ...], *arguments: object) -> subprocess.Popen:
    return subprocess.Popen(
        [*prefix, sys.executable, "-c", IMPATIENT, *map(str, arguments)], env={**os.environ, **QUIET},
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def run(prefix: tuple[str, ...], *arguments: object, meanwhile=lambda: None) -> str:
    """What the command says; ``meanwhile`` is called once it has begun."""
    process = command(prefix, *arguments)
    try:
        meanwhile()
        said = process.communicate(timeout=300)[1]
    finally:
        process.kill()
    assert process.returncode in (0, 3), said
    return said


def written(folder: Path, but: tuple[str, ...]) -> dict[str, bytes]:
    """All files by name; of results.csv without the seconds."""
    files = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*.*") if file.name not in but}
    if "results.csv" in files:
        rows = [line.split(b",") for line in files["results.csv"].splitlines()]
        files["results.csv"] = b"\n".join(b",".join(row[:3] + row[4:]) for row in rows)
    return files


def lines(file: Path) -> list[bytes]:
    return file.read_bytes().splitlines() if file.exists() else []


@pytest.mark.slow
def test_a_batch_of_which_one_worker_is_killed_and_one_stopped(machines, tmp_path):
    network, cluster = machines
    killed, stopped, _ = workers = [worker_on(n, network, cluster) for n in (1, 2, 3)]
    for name in "ab":
        cloud = read_cloud(SAMPLES / f"scan_{name}.ply")
        write_cloud(tmp_path / f"{name}.ply", cloud.select(slice(None, None, 8)))
    shutil.copy(SAMPLES / "truth.txt", tmp_path)
    manifest = tmp_path / "pairs.csv"
    manifest.write_text("source,target,init\n" + 12 * "a.ply,b.ply,truth.txt\n")

    def harm() -> None:
        wait_for(lambda: len(lines(tmp_path / "there" / "results.csv")) >= 2)
        killed.kill()
        stop(stopped)

    given = ("batch", manifest, "--aligned", "--out")
    try:
        said = run(network.on(0), *given, tmp_path / "there", "--dask", cluster.address, meanwhile=harm)
    finally:
        for worker in workers:
            worker.kill()
    run((), *given, tmp_path / "here", "--workers", 2)
    assert " 0 failed" in said
    there, here = (written(tmp_path / name, but=("settings.json",)) for name in ("there", "here"))
    metrics = [name for name in here if name.startswith("metrics")]  # seconds are in them
    assert len(metrics) == 12
    assert set(there) == set(here)
    for name in set(here) - set(metrics):
        assert there[name] == here[name], name


@pytest.mark.slow
def test_a_network_of_which_one_worker_is_killed_and_one_cut_off(machines, tmp_path):
    network, cluster = machines
    workers = [worker_on(n, network, cluster) for n in (1, 2, 3)]
    T = np.array([[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1.0]])
    (tmp_path / "scans").mkdir()
    for name, moved in (("a", "c"), ("b", "d")):
        cloud = read_cloud(SAMPLES / f"scan_{name}.ply")
        write_cloud(tmp_path / "scans" / f"{name}.ply", cloud.select(slice(None, None, 10)))
        write_cloud(tmp_path / "scans" / f"{moved}.ply", cloud.select(slice(3, None, 10)).transformed(T))

    def harm() -> None:
        wait_for(lambda: len(lines(tmp_path / "there" / "journal.jsonl")) >= 2)  # its head, and a pair
        workers[0].kill()
        network.pull(2)

    given = ("multiway", tmp_path / "scans", "--out")
    try:
        run(network.on(0), *given, tmp_path / "there", "--dask", cluster.address, meanwhile=harm)
    finally:
        for worker in workers:
            worker.kill()
    run((), *given, tmp_path / "here", "--workers", 2)
    there, here = (written(tmp_path / name, but=("network.json", "journal.jsonl")) for name in ("there", "here"))
    assert {"scans.csv", "links.csv", "network.g2o"} < set(here)
    assert there == here
