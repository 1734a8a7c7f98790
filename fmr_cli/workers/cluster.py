"""The workers of a Dask scheduler. Dask moves the tasks and tries those of dead workers elsewhere; here is the rest.

A worker is given tasks (``handing``) once it has said that it has this version of fmr. One that keeps silent gets no
more of them and what it has goes to others too; the first answer counts, since all give the same. One that cannot do a
task (a file that is not there) is left out. Every wait has an end.
"""

from __future__ import annotations

import asyncio
import logging
import platform
import re
import signal
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from http import HTTPStatus
from typing import Any

import fmr_cli
from fmr_cli.cores import usable_cores
from fmr_cli.errors import FmrError
from fmr_cli.workers.base import Answer, LostError, Task, forget

CONNECT = 10.0  # s that a scheduler has to answer, and to come back after the connection was lost
UNHEARD = 60.0  # s of silence of a scheduler whose connection holds: it is busy, or stopped
NO_WORKERS = 60.0  # s to wait for a first worker, or for another one when all are gone
LOOK = 2.0  # s between two looks at which workers there are
LIBRARIES = ("numpy", "scipy", "small_gicp")  # whose versions may change the last bits of a result

# Asked of every worker, by Python's own names, since it may have no fmr.
WHAT_IT_HAS = (
    "(__import__('fmr_cli').__version__, {"
    + ", ".join(f"'{name}': __import__('importlib.metadata').metadata.version('{name}')" for name in LIBRARIES)
    + ", 'Python': '.'.join(__import__('platform').python_version_tuple()[:2])"
    + ", 'processor': __import__('platform').machine()})"
)


class DaskWorkers:
    """The workers of a scheduler, as a context: it connects, and leaves what others run there alone.

    address: of a scheduler, such as tcp://host:8786, or tls://host:8786 with certificates in Dask's configuration;
    "local" starts a scheduler here with ``count`` worker processes (None: one a core), in a script to be called under
    ``if __name__ == "__main__"``, since Dask runs scripts again in its workers; or a ``distributed.Client``,
    which stays open. say: is told the dashboard's address, and what is odd about a worker.

    Raises FmrError where Dask is not installed, nobody answers, or no worker can be used.
    """

    remote = True

    def __init__(
        self, address: Any, count: int | None = None, say: Callable[[str], None] = logging.getLogger(__name__).warning
    ) -> None:
        self.address, self.wanted, self.say = address, count, say
        if isinstance(address, str) and address != "local" and "://" not in address:
            self.address = f"tcp://{address}"
        self.name = self.address if isinstance(address, str) else "the Dask client"
        self.fit: dict[str, int] = {}  # threads of each worker that can be used
        self.asked: dict[str, Any] = {}  # what each new worker has, once it answers
        self.refused: dict[str, str] = {}  # and why
        self.silent: set[str] = set()
        self.looked = self.had_workers = 0.0
        self.unheard: float | None = None  # since when the scheduler keeps silent
        self.client: Any = None
        self.cluster: Any = None

    @property
    def count(self) -> int:
        """Tasks that are worked on at a time, now."""
        return max(1, sum(self.fit.values()))

    # Coming and going.

    def __enter__(self) -> DaskWorkers:
        distributed = library()
        quiet(distributed)
        if isinstance(self.address, distributed.Client):
            self.client = self.address
        elif self.address == "local":
            import dask

            # Nobody looks at the profile that each worker takes a hundred times a second
            unwatched = dask.config.set({"distributed.worker.profile.enabled": False})
            with unwatched, deaf_to_interrupts():  # Ctrl-C ends this process, which ends the workers
                self.cluster = distributed.LocalCluster(
                    n_workers=self.wanted or usable_cores(), threads_per_worker=1,
                    dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
                )  # fmt: skip
            self.client = distributed.Client(self.cluster, timeout=CONNECT, set_as_default=False)
        else:
            check_address(self.address)
            try:
                asyncio.run(shake_hands(self.address))
                self.client = distributed.Client(self.address, timeout=CONNECT, set_as_default=False)
            except Exception as error:  # what does not speak Dask's language is taken for a length of any size
                why = "it speaks another language" if isinstance(error, MemoryError) else reason(error)
                why = re.sub("^in <.*?>: ", "", why)[:120]  # without the name of Dask's own connection
                raise FmrError(
                    f"--dask {self.address}: no Dask scheduler answers there ({why}); check the port, which is not "
                    "the dashboard's, and whether it wants tls:// and certificates that it knows"
                ) from None
        try:
            if has_page(self.client.dashboard_link):
                self.say(f"dashboard: {self.client.dashboard_link}")
            self.had_workers = begin = time.monotonic()
            waits = False
            while not self.fit:
                self.look_at_workers()
                if not waits and time.monotonic() - begin > LOOK and not (self.fit or self.asked):
                    waits = True
                    self.say(f"waiting for workers, {NO_WORKERS:.0f} s at most")
                time.sleep(0.02)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # what they keep for these runs; nobody waits for those that keep silent
            library().fire_and_forget([self.client.submit(forget, workers=[worker], pure=False) for worker in self.fit])
        if self.client is not self.address:
            try:
                self.client.close(timeout=5)
            except Exception:  # the scheduler does not answer: nothing is to be tried again at the end of the process
                self.client.status = "closed"
        if self.cluster is not None:
            self.cluster.close()

    # Which workers there are.

    def look_at_workers(self) -> set[str]:
        """Asks the scheduler which workers there are, at most every LOOK seconds, and new ones what they have."""
        if self.client.status == "closed":
            raise self.lost()
        now = time.monotonic()
        if now - self.looked >= LOOK or not self.fit:
            there = self.ask_scheduler(lambda: self.client.nthreads(callback_timeout=CONNECT))
            self.looked = now
            if there is not None:
                self._note_workers(there)
        for address, future in list(self.asked.items()):
            if future.done():
                del self.asked[address]
                self._check(address, future)
        return set(self.fit)

    def _note_workers(self, there: dict[str, int]) -> None:
        self.threads = there
        for known in (self.fit, self.asked, self.refused):
            for address in set(known) - set(there):
                del known[address]
        self.silent &= set(there)
        for address in set(there) - set(self.fit) - set(self.asked) - set(self.refused):
            self.asked[address] = self.submit(eval, WHAT_IT_HAS, {address})
        now = time.monotonic()
        if self.fit or (self.asked and now - self.had_workers < NO_WORKERS):
            self.had_workers = now if self.fit else self.had_workers
        elif self.refused and not self.asked:
            address, why = next(iter(self.refused.items()))
            raise FmrError(f"--dask {self.name}: none of {len(self.refused)} workers can be used; {address} {why}")
        elif now - self.had_workers >= NO_WORKERS:
            which = f"its {len(self.asked)} workers do not answer" if self.asked else "it has no workers"
            raise FmrError(
                f"--dask {self.name}: {which}, for {NO_WORKERS:.0f} s now; start some with: dask worker ADDRESS"
            )

    def _check(self, address: str, future: Any) -> None:
        """Takes a worker up, or refuses it."""
        try:
            version, libraries = future.result(timeout=CONNECT)
        except (TimeoutError, OSError, CancelledError):
            return  # asked again at the next look
        except Exception as error:  # whatever its Python could not do
            missing = getattr(error, "name", None) or str(error)
            return self.refuse(address, f"lacks {missing}: install fmr-cli {fmr_cli.__version__} there")
        if version != fmr_cli.__version__:
            return self.refuse(address, f"has fmr {version}, this is {fmr_cli.__version__}: install one version")
        self.fit[address] = self.threads[address]
        self.had_workers = time.monotonic()
        odd = [f"{k} {v} (here {mine})" for k, v in libraries.items() if v != (mine := what_is_here()[k])]
        if odd:
            self.say(f"worker {address} has {', '.join(odd)}: the last bits of a result may differ")
        if self.fit[address] > 4:
            self.say(
                f"worker {address} has {self.fit[address]} threads in one process, which hold each other up; better: "
                f"dask worker --nworkers {self.fit[address]} --nthreads 1"
            )

    def refuse(self, address: str, why: str) -> None:
        self.fit.pop(address, None)
        self.refused[address] = why
        self.say(f"worker {address} is left out: it {why}")

    def ask_scheduler(self, question: Callable[[], Any]) -> Any:
        """What the scheduler says, or None where it does not; a FmrError after UNHEARD s, or once the client is closed.

        A client whose connection is lost closes itself after CONNECT seconds of trying again.
        """
        try:
            answer = question()
        except (OSError, TimeoutError, CancelledError, RuntimeError, AttributeError):  # the last two: while it closes
            self.unheard = self.unheard or time.monotonic()
            if self.client.status == "closed" or time.monotonic() - self.unheard > UNHEARD:
                raise self.lost() from None
            time.sleep(0.2)
            return None
        self.unheard = None
        return answer

    def lost(self) -> FmrError:
        return FmrError(f"--dask {self.name}: lost the connection to the scheduler; what is written stays")

    # The work.

    def run(
        self, function: Callable[[Task], Answer], tasks: Iterable[Task]
    ) -> Generator[Answer | LostError, None, None]:
        """As ``Workers.run``. Raises FmrError where the scheduler is lost, or no worker is left that can be used."""
        from fmr_cli.workers.handing import Handing

        fetchers = ThreadPoolExecutor(8, "fetch")
        try:
            yield from Handing(self, function, tasks, fetchers).answers()
        finally:
            fetchers.shutdown(wait=False, cancel_futures=True)  # one may be waiting for a worker that keeps silent

    def submit(self, function: Callable[..., Any], argument: Any, to: set[str]) -> Any:
        """A future of function(argument) on one of these workers."""
        key = f"fmr-{uuid.uuid4().hex}"
        try:
            return self.client.submit(
                function, argument, key=key, pure=False, workers=sorted(to), allow_other_workers=False
            )
        except Exception:
            if self.client.status == "closed":
                raise self.lost() from None
            raise

    def responsive(self) -> set[str]:
        """The workers that can be used and aren't silent; where all are, all."""
        return set(self.fit) - self.silent or set(self.fit)

    def holders(self) -> dict[str, str]:
        """The worker of each task, by its key, that is being worked on or next in line."""
        tasks = self.ask_scheduler(self.client.processing) or {}
        return {key: worker for worker, keys in tasks.items() for key in keys}

    def give_up(self, futures: list[Any]) -> None:
        """Cancels what is under way."""
        with suppress(Exception):
            if futures:
                self.client.cancel(futures, force=True)


@contextmanager
def deaf_to_interrupts() -> Iterator[None]:
    """Processes that are started within do not hear Ctrl-C, which goes to all that share a terminal."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def what_is_here() -> dict[str, str]:
    """As WHAT_IT_HAS, of this process."""
    from importlib.metadata import version

    here = {name: version(name) for name in LIBRARIES}
    return here | {"Python": ".".join(map(str, sys.version_info[:2])), "processor": platform.machine()}


def library() -> Any:
    """distributed. Raises FmrError where it is not installed."""
    try:
        import distributed
    except ImportError:
        raise FmrError("--dask needs the libraries dask and distributed: pip install 'fmr-cli[dask]'") from None
    return distributed


def quiet(distributed: Any) -> None:
    """What Dask logs and warns about is said here in one line each, or does not matter."""
    for name in list(logging.Logger.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado", "asyncio"):  # asyncio: of futures that were given up
            logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", category=distributed.versions.VersionMismatchWarning)


def check_address(address: str) -> None:
    """Raises FmrError for what is no address, one where nobody listens, or TLS without certificates."""
    from distributed.comm import get_address_host_port

    scheme = address.split("://")[0]
    try:
        if scheme not in ("tcp", "tls"):
            raise ValueError(f"{scheme}:// is not spoken here")
        host, port = get_address_host_port(address)
    except ValueError as error:
        raise FmrError(f"--dask {address}: {reason(error)}; give an address such as tcp://host:8786") from None
    if scheme == "tls":
        check_certificates(address)
    try:
        socket.create_connection((host, port), CONNECT).close()
    except OSError as error:
        raise FmrError(
            f"--dask {address}: nobody answers there ({reason(error)}); check the address, or start: dask scheduler"
        ) from None


def check_certificates(address: str) -> None:
    """Raises FmrError where Dask's configuration names none for a client, or some that cannot be read."""
    from distributed import Security

    remedy = "see distributed.comm.tls in Dask's configuration: ca-file, client.cert, client.key"
    files = [file for file in Security().get_tls_config_for_role("client").values() if file and "\n" not in file]
    for file in files:  # here, since the message of a library for TLS does not say which one
        try:
            open(file, "rb").close()
        except OSError as error:
            raise FmrError(f"--dask {address}: {file}: cannot be read ({reason(error)}); {remedy}") from None
    try:
        there = Security().get_connection_args("client").get("ssl_context")
    except OSError as error:  # such as ssl.SSLError
        raise FmrError(f"--dask {address}: no certificates in {', '.join(files)} ({reason(error)}); {remedy}") from None
    if not there:
        raise FmrError(f"--dask {address}: no certificates for TLS; {remedy}")


def has_page(link: str) -> bool:
    """Whether there may be something at an address: False where its server says that there is not, as without bokeh."""
    try:
        urllib.request.urlopen(urllib.request.Request(link, method="HEAD"), timeout=2).close()
    except urllib.error.HTTPError as error:
        return error.code != HTTPStatus.NOT_FOUND
    except (OSError, ValueError):
        return bool(link)  # maybe through a tunnel
    return True


async def shake_hands(address: str) -> None:
    """Raises whatever Dask does where something else than a scheduler answers, such as its own dashboard.

    A ``Client`` itself would wait without end for an answer, and for twenty seconds more when it fails.
    """
    from distributed import Security
    from distributed.comm import connect

    try:
        async with asyncio.timeout(CONNECT):
            comm = await connect(address, timeout=CONNECT, **Security().get_connection_args("client"))
    except TimeoutError:
        raise OSError(f"nothing for {CONNECT:.0f} s") from None
    comm.abort()


def reason(error: BaseException) -> str:
    return " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())[:200]
