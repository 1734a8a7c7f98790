"""A real scheduler and real workers: the answers in order whatever happens to some workers, or one clear line.

The tests share a cluster as far as they can, since each of its processes takes a second to start.
"""

from __future__ import annotations

import csv
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")

from workers import work  # noqa: E402
from workers.cluster import Cluster, certificates, stop, wait_for  # noqa: E402

import fmr_cli  # noqa: E402
from fmr_cli import read_cloud, write_cloud  # noqa: E402
from fmr_cli.batch import align_batch  # noqa: E402
from fmr_cli.cli.app import main  # noqa: E402
from fmr_cli.errors import FmrError  # noqa: E402
from fmr_cli.multiway import align_many  # noqa: E402
from fmr_cli.multiway.export import write_network  # noqa: E402
from fmr_cli.workers import DaskWorkers, cluster, handing  # noqa: E402
from fmr_cli.workers.base import LostError  # noqa: E402

SAMPLES = Path(__file__).parents[2] / "samples"
WRONG_VERSION = "import fmr_cli; fmr_cli.__version__ = '0.0.1'"
WITHOUT_FMR = "import sys; sys.modules['fmr_cli'] = None"


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A scheduler with two workers that can be used, and one that has another version."""
    with Cluster(tmp_path_factory.mktemp("dask")) as found:
        for first in ("", "", WRONG_VERSION):
            found.worker(first)
        with distributed.Client(found.address, set_as_default=False) as client:
            client.wait_for_workers(3, timeout=120)
        yield found


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(handing, "PATIENCE", 2.0)
    monkeypatch.setattr(handing, "SLOWER", 1.5)
    monkeypatch.setattr(handing, "TICK", 0.1)
    monkeypatch.setattr(cluster, "LOOK", 0.2)
    monkeypatch.setattr(cluster, "CONNECT", 10.0)


def have(workers: DaskWorkers, count: int) -> None:
    """Waits until so many workers can be used."""
    wait_for(lambda: workers.look_at_workers() and len(workers.fit) == count)


def test_answers_in_order_by_workers_of_this_version_only(shared):
    said = []
    with DaskWorkers(shared.address, say=said.append) as workers:
        wait_for(lambda: workers.look_at_workers() and len(workers.fit) == 2 and workers.refused)
        assert [*workers.run(work.later, range(30))] == [*range(30)]
        assert len(set(workers.run(work.process_of, range(40)))) == 2
        with pytest.raises(FmrError, match="three is too much"):
            [*workers.run(work.complains_of_three, range(9))]
    (line,) = [line for line in said if "left out" in line]
    assert "0.0.1" in line
    assert fmr_cli.__version__ in line


def test_what_is_kept_is_let_go_of_at_the_end(shared):
    with DaskWorkers(shared.address, say=lambda _: None) as workers:
        have(workers, 2)
        assert max(workers.run(work.so_far, range(20))) > 5
        assert max(workers.run(work.so_far, range(2))) > 5
    with DaskWorkers(shared.address, say=lambda _: None) as workers:
        assert max(workers.run(work.so_far, range(2))) <= 2


def test_closing_gives_up_what_is_under_way(shared):
    with DaskWorkers(shared.address, say=lambda _: None) as workers:
        answers = workers.run(work.slow, range(50))
        next(answers)
        answers.close()
        wait_for(lambda: not any(workers.client.processing().values()))


def test_a_client_that_is_given_stays_open(shared):
    with distributed.Client(shared.address, set_as_default=False) as client:
        with DaskWorkers(client, say=lambda _: None) as workers:
            assert [*workers.run(work.square, range(3))] == [0, 1, 4]
        assert client.status == "running"


@pytest.mark.slow
def test_a_file_that_one_worker_does_not_see(shared, tmp_path):
    """The third worker has an empty folder in the place of ours."""
    (tmp_path / "scan.ply").write_text("")
    unshare = ("unshare", "-rm", "sh", "-c", f'mount -t tmpfs none {tmp_path} && exec "$@"', "sh")
    if not shutil.which("unshare") or subprocess.run([*unshare, "true"], capture_output=True).returncode:
        pytest.skip("this machine lets no one mount in a namespace of their own")
    blind = shared.worker(prefix=unshare)
    path, said = str(tmp_path / "scan.ply"), []
    try:
        with DaskWorkers(shared.address, say=said.append) as workers:
            have(workers, 3)
            assert len(set(workers.run(work.with_file, 20 * [path]))) == 2
            assert any(f"{path} is not there" in line and "left out" in line for line in said)
            with pytest.raises(FmrError, match="none of 4 workers can be used"):
                [*workers.run(work.with_file, [str(tmp_path / "nowhere")])]
    finally:
        blind.kill()


def table(out: Path) -> list[dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


@pytest.mark.slow
def test_a_batch_whose_workers_are_killed_and_stopped_gives_the_same_files(shared, tmp_path):
    """Of four workers one is killed and one stopped; the run is cut off, and gone on with by processes.

    All pairs start from the truth, which is quick.
    """
    for name in "ab":
        cloud = read_cloud(SAMPLES / f"scan_{name}.ply")
        write_cloud(tmp_path / f"{name}.ply", cloud.select(slice(None, None, 8)))
    manifest = tmp_path / "pairs.csv"
    shutil.copy(SAMPLES / "truth.txt", tmp_path)
    manifest.write_text("source,target,init\n" + 3 * "a.ply,b.ply,truth.txt\n" + "a.ply,nowhere.ply,\n"
                        + 2 * "a.ply,b.ply,truth.txt\n")  # fmt: skip
    killed, stopped = shared.worker(), shared.worker()

    def harm(row, done, total):
        if done == 1:
            killed.kill()
            stop(stopped)
        if done == 5:
            raise KeyboardInterrupt

    with DaskWorkers(shared.address, say=lambda _: None) as workers:
        have(workers, 4)
        with pytest.raises(KeyboardInterrupt):
            align_batch(manifest, tmp_path / "dask", aligned=True, workers=workers, on_row=harm)
    stopped.kill()
    align_batch(manifest, tmp_path / "dask", aligned=True, resume=True, workers=2)
    align_batch(manifest, tmp_path / "here", aligned=True, workers=1)
    assert [row["status"] for row in table(tmp_path / "here")].count("failed") == 1
    assert table(tmp_path / "dask") == table(tmp_path / "here")
    files = {path.relative_to(tmp_path / "here") for path in (tmp_path / "here").rglob("*.*")}
    assert files == {path.relative_to(tmp_path / "dask") for path in (tmp_path / "dask").rglob("*.*")}
    for file in files:
        if file.parent.name in ("transforms", "aligned"):
            assert (tmp_path / "dask" / file).read_bytes() == (tmp_path / "here" / file).read_bytes()


@pytest.mark.slow
def test_a_worker_whose_disk_is_full_is_left_out(shared, tmp_path):
    """One worker may write no file of more than 512 bytes: the same as far as it can tell."""
    cloud = read_cloud(SAMPLES / "scan_a.ply").select(slice(None, None, 8))
    write_cloud(tmp_path / "a.ply", cloud)
    (tmp_path / "pairs.csv").write_text("source,target,init\n" + 6 * "a.ply,a.ply,identity\n")
    full, said = shared.worker(prefix=("sh", "-c", 'ulimit -f 1 && exec "$@"', "sh")), []
    try:
        with DaskWorkers(shared.address, say=said.append) as workers:
            have(workers, 3)
            rows = align_batch(tmp_path / "pairs.csv", tmp_path / "out", aligned=True, workers=workers)
    finally:
        full.kill()
    assert [row["status"] for row in rows] == 6 * ["aligned"]
    assert len([*(tmp_path / "out" / "aligned").iterdir()]) == 6
    assert any("left out" in line and "cannot be written (File too large)" in line for line in said)


@pytest.mark.slow
def test_a_network_whose_workers_are_killed_and_stopped_gives_the_same_files(shared, tmp_path):
    """Four scans, of which two are moved copies of the others' other points; one worker is killed, one stopped."""
    T = np.array([[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1.0]])
    scans = []
    for name, moved in (("a", "c"), ("b", "d")):
        cloud = read_cloud(SAMPLES / f"scan_{name}.ply")
        scans += [tmp_path / f"{name}.ply", tmp_path / f"{moved}.ply"]
        write_cloud(scans[-2], cloud.select(slice(None, None, 10)))
        write_cloud(scans[-1], cloud.select(slice(3, None, 10)).transformed(T))
    killed, stopped = shared.worker(), shared.worker()
    harmed = []

    def harm(now):
        if now.stage == "registering" and now.done == 1 and not harmed:
            killed.kill()
            stop(stopped)
            harmed.append(now.total)

    with DaskWorkers(shared.address, say=lambda _: None) as workers:
        have(workers, 4)
        there = align_many(scans, workers=workers, progress=harm)
    stopped.kill()
    here = align_many(scans, workers=2)
    assert harmed[0] > 1
    assert len(here.links) == 6
    found = []
    for name, network in (("there", there), ("here", here)):
        (tmp_path / name).mkdir()
        write_network(network, tmp_path / name)
        files = {file.relative_to(tmp_path / name): file for file in (tmp_path / name).rglob("*.*")}
        found.append({path: file.read_bytes() for path, file in files.items() if path.name != "network.json"})
    assert len(found[0]) == 4 + 6 + 3  # poses, links, tables and graph
    assert found[0] == found[1]


@pytest.mark.slow
def test_the_command_evaluates_the_same(shared, tmp_path, monkeypatch, capsys):
    found = []
    experiment = ["--no-align", "--experiments", "noise", "--pairs", "2", "--points", "64"]
    for more in (["--dask", shared.address], []):
        out = tmp_path / f"evaluation{len(more)}"
        monkeypatch.setattr(sys, "argv", ["fmr", "evaluate", str(SAMPLES), "-o", str(out), *experiment, *more])
        with pytest.raises(SystemExit) as end:
            main()
        said = capsys.readouterr().err
        assert end.value.code == 0, said
        assert "dashboard: http" not in said  # this scheduler has none
        with (out / "results.csv").open(newline="") as file:
            found.append([{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)])
    assert len(found[0]) == 10
    assert found[0] == found[1]


@pytest.mark.slow
def test_a_task_that_kills_its_workers_is_the_only_one_lost(shared):
    for _ in range(4):
        shared.worker()
    with DaskWorkers(shared.address, say=lambda _: None) as workers:
        have(workers, 6)
        answers = [*workers.run(work.dies_of_three, range(6))]
    assert [a for a in answers if not isinstance(a, LostError)] == [0, 1, 2, 4, 5]


@pytest.mark.slow
def test_no_workers_then_none_that_can_be_used_then_no_scheduler(tmp_path, monkeypatch):
    with Cluster(tmp_path) as alone:
        monkeypatch.setattr(cluster, "NO_WORKERS", 0.5)
        monkeypatch.setattr(cluster, "LOOK", 0.1)
        said = []
        with pytest.raises(FmrError, match="it has no workers"), DaskWorkers(alone.address, say=said.append):
            pass
        assert said == ["waiting for workers, 0 s at most"]
        monkeypatch.setattr(cluster, "NO_WORKERS", 120)
        without = alone.worker(WITHOUT_FMR)
        with (
            pytest.raises(FmrError, match=r"none of 1 workers can be used; .* lacks fmr_cli"),
            DaskWorkers(alone.address, say=lambda _: None),
        ):
            pass
        without.kill()
        alone.worker()
        with DaskWorkers(alone.address, say=lambda _: None) as workers:
            answers = workers.run(work.slow, range(100))
            assert [next(answers) for _ in range(5)] == [*range(5)]
            alone.scheduler.kill()
            begin = time.monotonic()
            with pytest.raises(FmrError, match="lost the connection"):
                list(answers)
            assert time.monotonic() - begin < 10 * cluster.CONNECT


@pytest.fixture
def server():
    """Listens on a port of this machine, and gives each that comes what it is told to; or nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        came, says = [], []

        def serve():
            while True:
                try:
                    came.append(listening.accept()[0])
                except OSError:
                    return
                came[-1].recv(1024 if says else 1)
                came[-1].sendall(b"".join(says))

        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{listening.getsockname()[1]}", says
        listening.shutdown(socket.SHUT_RDWR)
    for connection in came:
        connection.close()


@pytest.mark.parametrize(("says", "said"), [(b"", "nothing for 1 s"), (b"HTTP/1.1 400 No\r\n\r\n", "another language")])
def test_what_answers_is_no_scheduler(server, monkeypatch, says, said):
    """As the dashboard's port, a web server's, one behind a gate that lets nothing through."""
    monkeypatch.setattr(cluster, "CONNECT", 1.0)
    address, what = server
    what.append(says)
    with pytest.raises(FmrError, match=f"no Dask scheduler answers there.*{said}"):
        DaskWorkers(address).__enter__()


@pytest.mark.parametrize(("status", "there"), [(b"200 OK", True), (b"404 Not Found", False), (b"403 No", True)])
def test_the_dashboard_is_said_where_there_may_be_one(server, status, there):
    address, says = server
    says.append(b"HTTP/1.1 " + status + b"\r\nConnection: close\r\n\r\n")
    assert cluster.has_page(f"http://{address}/status") == there
    assert cluster.has_page("http://127.0.0.1:9/status")  # maybe through a tunnel
    assert not cluster.has_page("")


@pytest.mark.slow
def test_tls(tmp_path):
    """A scheduler that wants certificates takes a client that shows one, and turns the others away."""
    if not shutil.which("openssl"):
        pytest.skip("openssl makes the certificates")
    certificates(tmp_path)

    def shown(name: str) -> dict[str, str]:
        """Dask's settings for whoever shows this certificate."""
        files = {"cert": tmp_path / f"{name}.pem", "key": tmp_path / f"{name}-key.pem"}
        tls = {
            f"{role}.{what}": str(file) for role in ("scheduler", "worker", "client") for what, file in files.items()
        }
        return {
            f"distributed.comm.tls.{key}": value for key, value in ({"ca-file": str(tmp_path / "ca.pem")} | tls).items()
        }

    variables = {f"DASK_{key.upper().replace('.', '__').replace('-', '_')}": v for key, v in shown("node").items()}
    with Cluster(tmp_path, "tls", DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION="True", **variables) as secured:
        assert secured.address.startswith("tls://")
        secured.worker()
        with dask.config.set(shown("node")), DaskWorkers(secured.address, say=lambda _: None) as workers:
            assert [*workers.run(work.square, range(3))] == [0, 1, 4]
        for name, said in (("stranger", "no Dask scheduler answers there"), ("nobody", "nobody.pem: cannot be read")):
            with dask.config.set(shown(name)), pytest.raises(FmrError, match=said):
                DaskWorkers(secured.address).__enter__()
        with pytest.raises(FmrError, match="no Dask scheduler answers there"):
            DaskWorkers(secured.address.replace("tls", "tcp")).__enter__()


@pytest.mark.parametrize(
    ("address", "said"),
    [("tcp://127.0.0.1:9", "nobody answers"), ("tls://127.0.0.1:9", "certificates"), ("x://y", "give an address"),
     ("host", "give an address")],
)  # fmt: skip
def test_an_address_where_nobody_is(address, said):
    with pytest.raises(FmrError, match=said) as error:
        DaskWorkers(address).__enter__()
    assert os.linesep not in str(error.value)
