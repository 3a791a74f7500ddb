"""Where a stage's ``map`` runs: in this process, on a local Dask cluster, or on one that is there already.

Dask is imported, and a local cluster started, by the first ``map`` that has two items or more: a run that has nothing to do
waits for neither. Items are handed out a few at a time, so results wait in memory for a bounded number of blocks.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import logging
import os
import signal
import socket
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import brmgeo
from brmgeo import files
from brmgeo.errors import SettingsError, WorkflowError, one_line
from brmgeo.workflow.stage import Map, R, T

_MEMORY_SHARE = 0.7
_LONGEST_GREETING = 1 << 20
#: How many threads libraries take.
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
#: Loggers whose warnings go to a file, and how.
_LOGGERS = ("distributed", "distributed.client", "tornado", "bokeh")
_LOG_FORMAT = "%(asctime)s %(process)d %(name)s %(levelname)s %(message)s"


@dataclass(frozen=True, slots=True)
class Waits:
    """How long a run waits for others; all in seconds.

    Attributes:
        answer_s: for an answer of a scheduler or a worker.
        look_s: between two looks at who is there, while a result is awaited.
        told_s: without a worker until that is said.
        end_s: without a worker until the run gives up; a result starts the count again.
    """

    answer_s: float = 5.0
    look_s: float = 2.0
    told_s: float = 10.0
    end_s: float = 60.0


def serial_map(function: Callable[[T], R], items: Iterable[T], /) -> Iterator[R]:
    """``map`` in this process, one item after another."""
    for item in items:
        yield function(item)


@contextlib.contextmanager
def scheduler(
    spec: str | None,
    *,
    shared: Path | str | None = None,
    log: Path | None = None,
    workers: int | None = None,
    say: Callable[[str], None] | None = None,
    waits: Waits = Waits(),
) -> Iterator[Map]:
    """The ``map`` that ``spec`` names, closed at the end.

    Args:
        spec: ``serial`` (this process), None, empty or ``local`` (a cluster of this machine's own, one thread a
            worker, started when there is work), or the address of a running Dask scheduler such as ``tcp://host:8786``.
        shared: folder that the workers must see (the store, or the results).
        log: file that Dask's warnings are appended to; None drops them.
        workers: workers of a local cluster; the number of CPUs that this process may use by default.
        say: takes the line that tells the dashboard's address, and one when no worker is there any more.
        waits: how long others are waited for.

    Raises SettingsError for another ``spec``; from the first ``map`` on, WorkflowError when the scheduler does not answer,
    has no workers, or has workers with another brmgeo or without the shared folder, when all workers are gone and none
    comes back, or when workers die again and again over one item.
    """
    spec = (spec or "local").strip()
    if spec == "serial":
        yield serial_map
        return
    address = None if spec == "local" else spec
    if address is not None and (urlsplit(address).scheme not in ("tcp", "tls") or not _port(address)):
        raise SettingsError(
            f"scheduler {spec!r}: give serial, local or an address such as tcp://host:8786", needs="scheduler"
        )
    with contextlib.ExitStack() as stack:
        folder = Path(shared or stack.enter_context(files.scratch_folder("shared"))).absolute()
        cluster = _Dask(address, folder, log, workers, say or (lambda line: None), waits)
        stack.callback(cluster.close)
        yield cluster.map


class _Dask:
    """A Dask cluster that starts with the first work."""

    def __init__(
        self,
        address: str | None,
        shared: Path,
        log: Path | None,
        workers: int | None,
        say: Callable[[str], None],
        waits: Waits = Waits(),
    ) -> None:
        self._address = address
        self._shared = shared
        self._log = log
        self._workers = workers
        self._say = say
        self._waits = waits
        self._stack = contextlib.ExitStack()
        self._client: Any = None

    def map(self, function: Callable[[T], R], items: Iterable[T], /) -> Iterator[R]:
        work = list(items)
        if len(work) < 2 and self._client is None and self._address is None:
            yield from serial_map(function, work)  # one item needs no company
            return
        client = self._start()
        from distributed import CancelledError, KilledWorker
        from distributed.client import ClosedClientError
        from distributed.comm.core import CommClosedError

        waiting = iter(work)
        flying: deque[Any] = deque()
        try:
            threads = max(1, sum(self._threads(client, 4 * self._waits.answer_s).values()))
            while True:
                while len(flying) < 2 * threads + 1 and (item := next(waiting, flying)) is not flying:
                    flying.append(client.submit(function, item, pure=False))
                if not flying:
                    return
                result: R = self._result(client, flying[0], _name(function))
                flying.popleft().release()
                yield result
        except KilledWorker as error:
            raise WorkflowError(
                f"{_name(function)}: {error.allowed_failures + 1} workers died one after another over the same item, "
                f"most often for lack of memory; use smaller blocks or the scheduler 'serial'{self._see}",
                needs="scheduler",
            ) from None
        except (CancelledError, ClosedClientError, TimeoutError, OSError) as error:
            # An item's own errors pass; a connection that broke a moment before the client notices is the scheduler's end.
            gone = (CancelledError, ClosedClientError, CommClosedError)
            if client.status == "running" and not isinstance(error, gone):
                raise
            raise WorkflowError(
                f"{_name(function)}: {self._where} went away; start it and run again"
            ) from None
        finally:
            for future in flying:
                with contextlib.suppress(Exception):
                    future.cancel()

    def _threads(self, client: Any, wait_s: float) -> dict[str, int]:
        """Threads of each worker."""
        try:
            threads: dict[str, int] = client.nthreads(callback_timeout=wait_s)
        except TimeoutError:
            raise WorkflowError(
                f"{self._where} does not answer within {wait_s:g} s; start it and its workers again, and run again",
                needs="scheduler",
            ) from None
        return threads

    @property
    def _see(self) -> str:
        return f", see {self._log}" if self._log else ""

    @property
    def _where(self) -> str:
        return f"the scheduler {self._address or 'of this machine'}"

    def _result(self, client: Any, future: Any, name: str) -> Any:
        """The result of an item, waited for as long as anybody is there to make it."""
        from distributed import wait

        alone_s, told = 0.0, False
        since = time.monotonic()
        while True:
            try:
                wait([future], timeout=self._waits.look_s)  # type: ignore[no-untyped-call]
                return future.result(timeout=self._waits.end_s)
            except TimeoutError:
                if future.status == "error":
                    raise
            try:
                there = self._threads(client, self._waits.answer_s)
                missing = "" if there else f"{self._where} has no worker left"
            except WorkflowError:
                missing = f"{self._where} does not answer"
            before, since = since, time.monotonic()
            if not missing:
                continue
            # Workers that come and die again before they finish anything must not make this endless.
            alone_s += since - before
            if alone_s >= self._waits.told_s and not told:
                told = True
                self._say(f"{name}: {missing}; waiting up to {self._waits.end_s:.0f} s for one to come back")
            elif alone_s >= self._waits.end_s:
                raise WorkflowError(
                    f"{name}: {missing}, waited {alone_s:.0f} s for one; start workers again (fewer of them, if they died "
                    "for lack of memory) or take the scheduler 'serial'; what is finished is kept",
                    needs="scheduler",
                )

    def close(self) -> None:
        self._client = None
        # All work is done by now: a busy machine's workers that are slow to say goodbye must not make it fail.
        with contextlib.suppress(TimeoutError):
            self._stack.close()

    def _start(self) -> Any:
        if self._client is None:
            try:
                self._client = self._connect() if self._address else self._launch()
            except BaseException:
                self._stack.close()
                raise
        return self._client

    def _launch(self) -> Any:
        import dask
        from dask.system import CPU_COUNT
        from distributed import Client, LocalCluster
        from distributed.system import MEMORY_LIMIT
        from psutil import virtual_memory

        workers = self._workers or CPU_COUNT
        memory = int(min(virtual_memory().available, MEMORY_LIMIT) * _MEMORY_SHARE / workers)
        # Each worker is one of several on this machine: its libraries must not take all the cores for themselves.
        environment = {name: os.environ.get(name, "1") for name in _THREADS}
        # Dask reads it in a worker's first moment, before any plugin, and in that of one started anew.
        environment["DASK_LOGGING"] = repr(_logging_to(self._log))
        self._stack.enter_context(_environment(environment))  # Dask sets it in this process too, for good
        scratch = self._stack.enter_context(files.scratch_folder("dask"))
        self._stack.enter_context(
            dask.config.set(
                {"distributed.nanny.pre-spawn-environ": environment, "temporary-directory": str(scratch)}
            )
        )
        self._stack.enter_context(_logs_to(self._log))
        try:
            cluster = LocalCluster.__new__(LocalCluster)
            try:
                cluster.__init__(  # type: ignore[misc]
                    n_workers=workers,
                    threads_per_worker=1,
                    memory_limit=memory,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0" if _has_dashboard() else None,
                    silence_logs=logging.WARNING,
                )
            except BaseException:
                # Interrupted half-way it would go on starting, and end with the process, in scratch that is gone by then.
                with contextlib.suppress(Exception):
                    cluster.close()
                raise
            self._stack.enter_context(cluster)
            client = self._stack.enter_context(Client(cluster))  # type: ignore[no-untyped-call]
        except (OSError, RuntimeError, TimeoutError) as error:
            raise WorkflowError(
                f"the local Dask cluster does not start ({error}); run with the scheduler 'serial'{self._see}",
                needs="scheduler",
            ) from error
        client.register_plugin(_steady_worker())
        where = (
            f"dashboard {cluster.dashboard_link}"
            if _has_dashboard()
            else f"scheduler {cluster.scheduler_address}"
        )
        self._say(f"{workers} workers of {memory / 2**30:.1f} GiB on this machine, {where}")
        return client

    def _connect(self) -> Any:
        assert self._address is not None
        parts = urlsplit(self._address)
        wait_s = self._waits.answer_s
        other = f"scheduler {self._address}: something answers there, but not a Dask scheduler of our version"
        try:
            with socket.create_connection((parts.hostname or "", parts.port or 0), timeout=wait_s) as probe:
                # A scheduler greets first, with the length of its greeting, and Dask's client believes any length and waits
                # for it without end. With TLS the client greets.
                greets = parts.scheme == "tls" or 0 < _length(probe) <= _LONGEST_GREETING
        except OSError as error:
            raise WorkflowError(
                f"scheduler {self._address} does not answer ({error.strerror or error}); start it with "
                "`dask scheduler`, or take this machine's own",
                needs="scheduler",
            ) from None
        if not greets:
            raise WorkflowError(other, needs="scheduler")
        from distributed import Client

        self._stack.enter_context(_logs_to(self._log))
        try:
            client = self._stack.enter_context(Client(self._address, timeout=wait_s))  # type: ignore[no-untyped-call]
        except (OSError, TimeoutError, ValueError) as error:
            raise WorkflowError(f"{other} ({one_line(error)})", needs="scheduler") from None
        try:
            count = len(self._threads(client, wait_s))
            if not count:
                raise WorkflowError(
                    f"scheduler {self._address} has no workers; start some with `dask worker {self._address}`"
                )
            self._require_same_house(client)
        except TimeoutError:
            raise WorkflowError(
                f"scheduler {self._address}: one of its workers does not answer within {4 * wait_s:g} s; start it again",
                needs="scheduler",
            ) from None
        self._say(f"{count} workers of {self._address}, dashboard {client.dashboard_link}")
        return client

    def _require_same_house(self, client: Any) -> None:
        """Workers elsewhere must see the store and run this very code: keys do not tell one code from another."""
        token = self._shared / f".seen-{uuid.uuid4().hex}"
        token.touch()
        try:
            answers = client.run(
                look_around, str(token), on_error="return", callback_timeout=4 * self._waits.answer_s
            )
        finally:
            token.unlink(missing_ok=True)
        mine = _house()
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                raise WorkflowError(
                    f"worker {worker} cannot import brmgeo ({answer}); install brmgeo {brmgeo.__version__} there"
                )
            sees, house = answer
            if not sees:
                raise WorkflowError(
                    f"worker {worker} does not see {self._shared}; mount the same file system there, at the same path"
                )
            if house != mine:
                raise WorkflowError(
                    f"worker {worker} runs {house}, this is {mine}; install the same brmgeo and Python there and restart it"
                )


def _length(probe: socket.socket) -> int:
    """The first eight bytes that come, as Dask writes lengths; 0 where fewer come."""
    with probe.makefile("rb") as stream:
        head = stream.read(8)
    return int.from_bytes(head, "little") if len(head) == 8 else 0


def _house() -> str:
    """Python, brmgeo's version and a digest of its text, as one line."""
    digest = hashlib.sha256()
    root = Path(brmgeo.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return f"brmgeo {brmgeo.__version__} ({digest.hexdigest()[:8]}) on Python {sys.version_info[0]}.{sys.version_info[1]}"


def look_around(token: str) -> tuple[bool, str]:
    """What a worker answers: whether it sees a file of ours, and which house it runs (see ``_house``)."""
    return os.path.exists(token), _house()


@contextlib.contextmanager
def _environment(own: Mapping[str, str]) -> Iterator[None]:
    """``own`` stands in this process's environment while the body runs, and what stood there before stands there after."""
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _steady_worker() -> Any:
    """A worker plugin, so that restarted workers have it too: Ctrl-C is for the run alone, which then ends its workers."""
    from distributed import WorkerPlugin

    class SteadyWorker(WorkerPlugin):  # type: ignore[misc,unused-ignore]
        name = "brmgeo-steady"

        def setup(self, worker: Any) -> None:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, signal.SIG_IGN)

    return SteadyWorker()


def _logging_to(path: Path | None) -> dict[str, Any]:
    """Settings of ``logging`` under which warnings of Dask and Tornado go to ``path``, or nowhere."""
    nowhere: dict[str, Any] = {"class": "logging.NullHandler"}
    file = {"class": "logging.FileHandler", "filename": str(path), "delay": True, "formatter": "line"}
    quiet = {"level": "WARNING", "handlers": ["file"], "propagate": False}
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"line": {"format": _LOG_FORMAT}},
        "handlers": {"file": file if path else nowhere},
        "loggers": dict.fromkeys(_LOGGERS, quiet),
    }


@contextlib.contextmanager
def _logs_to(path: Path | None) -> Iterator[None]:
    """Dask's and Tornado's warnings of this process go to ``path``, or nowhere, while the body runs."""
    import distributed  # noqa: F401  # it sets up its loggers when imported, and would undo this later

    with contextlib.ExitStack() as stack:
        for name in _LOGGERS:
            logger = logging.getLogger(name)
            stack.callback(_restore, logger, logger.handlers, logger.level, logger.propagate)
            handler = logging.FileHandler(path, delay=True) if path else logging.NullHandler()
            stack.callback(handler.close)
            handler.setFormatter(logging.Formatter(_LOG_FORMAT))
            logger.handlers, logger.propagate = [handler], False
            logger.setLevel(logging.WARNING)
        yield


def _restore(logger: logging.Logger, handlers: list[logging.Handler], level: int, propagate: bool) -> None:
    logger.handlers, logger.propagate = handlers, propagate
    logger.setLevel(level)


def _has_dashboard() -> bool:
    return importlib.util.find_spec("bokeh") is not None


def _port(address: str) -> int:
    try:
        return urlsplit(address).port or 0
    except ValueError:
        return 0


def _name(function: Callable[..., object]) -> str:
    inner = getattr(function, "func", function)
    return str(getattr(inner, "__qualname__", inner))
