"""Workers of a sweep: processes of this machine, or of a Dask cluster that runs already. One job at a time each.

A worker is kept from job to job, so that imports and compiled programs are shared. One that dies costs its job a retry,
which goes on from the last checkpoint; the scheduler starts another.
"""

import contextlib
import importlib.util
import logging
import os
import queue
import secrets
import threading
import warnings
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import dask
import dask.utils
from distributed import Client, LocalCluster, WorkerPlugin

from simpel_cli.config.compose import Job
from simpel_cli.errors import ConfigError, did_you_mean
from simpel_cli.sweeps.job import Outcome, perform
from simpel_cli.sweeps.retry import SCHEDULER, outcome_of

MEMORY_EACH = 2.5e9  # bytes of a job, about
PATIENCE = 15.0  # s for a scheduler to answer, and for a worker of its to appear


@dataclass(frozen=True)
class Options:
    """The `hydra.launcher` group, see `conf/hydra/launcher/dask.yaml`. What users give is anything until `of` has checked it.

    Args:
        workers: processes of this machine; None: as many as cores and memory allow.
        address: of a scheduler that runs already; None: workers of this machine.
        memory: of a worker, e.g. `4GB`, or `auto`.
        dashboard: port; None: no dashboard.
    """

    workers: Any = None
    address: Any = None
    memory: Any = "auto"
    dashboard: Any = 8787

    @classmethod
    def of(cls, given: dict[str, Any]) -> "Options":
        """Check what was given.

        Raises:
            ConfigError: a key or a value.
        """
        names = list(cls.__dataclass_fields__)
        for key in given:
            if key not in names:
                raise ConfigError(
                    f"hydra.launcher.{key}: no such key.{did_you_mean(key, names)} (keys: {', '.join(names)})"
                )
        own = cls(**given)
        if own.workers is not None and not (type(own.workers) is int and 1 <= own.workers <= 1000):
            raise ConfigError(f"hydra.launcher.workers: got {own.workers}; allowed are 1 to 1000, and null.")
        if own.address is not None and not str(own.address).startswith(("tcp://", "tls://")):
            raise ConfigError(f"hydra.launcher.address: got {own.address}; it looks like tcp://HOST:PORT.")
        if own.memory != "auto":
            try:
                dask.utils.parse_bytes(own.memory)
            except (ValueError, TypeError, AttributeError) as error:
                raise ConfigError(
                    f"hydra.launcher.memory: got {own.memory}; it looks like 4GB, or is `auto`."
                ) from error
        if own.dashboard is not None and not (type(own.dashboard) is int and 0 <= own.dashboard < 65536):
            raise ConfigError(f"hydra.launcher.dashboard: got {own.dashboard}; it is a port, or null.")
        return own

    def processes(self, jobs: int) -> int:
        """Return the number of workers for so many jobs on this machine."""
        most = self.workers or max(1, min(_cores(), int(_memory() // MEMORY_EACH)))
        return min(most, jobs)


class Cluster:
    """Takes jobs, and gives their outcomes as they end.

    Args:
        options: of the launcher.
        jobs: how many there will be.
        root: directory of the sweep.

    Raises:
        ConfigError: the address, or a worker there cannot take jobs of ours.
    """

    def __init__(self, options: Options, jobs: int, root: Path) -> None:
        self._token = secrets.token_hex(8)
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()  # keys
        # here, and not with the scheduler: that would hold a dead worker against every job queued there
        self._waiting: deque[Job] = deque()
        self._given = 0
        self._running: dict[str, tuple[Job, Any]] = {}  # key -> job and future
        self._close = contextlib.ExitStack()
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said by outcomes
        settings = SCHEDULER | {
            "distributed.nanny.pre-spawn-environ": {},  # as many threads as `simpel fit` has: the same numbers
            "distributed.admin.tick.limit": "60s",
            "distributed.comm.timeouts.connect": f"{PATIENCE}s",
        }
        self._close.enter_context(dask.config.set(settings))
        self._close.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", module="distributed")
        warnings.filterwarnings("ignore", message="Port .* is already in use")
        if options.address is None:
            where = self._local(options, jobs)
        else:
            where = options.address
        try:
            self._client = self._close.enter_context(Client(where, timeout=PATIENCE, set_as_default=False))
        except (OSError, TimeoutError) as error:
            raise ConfigError(
                f"hydra.launcher.address: no scheduler answers at {options.address} within {PATIENCE:.0f} s. Start one with "
                "`dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`."
            ) from error
        if options.address is not None:
            self._check(options.address, root)
        else:
            self._client.register_plugin(_Deaf())

    @property
    def dashboard(self) -> str:
        """Address of the dashboard; empty: none."""
        if importlib.util.find_spec("bokeh") is None:
            return ""
        return str(self._client.dashboard_link or "")

    @property
    def workers(self) -> int:
        """Number of workers at the moment."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def submit(self, job: Job) -> None:
        """Queue a job."""
        self._waiting.append(job)
        self._feed()

    def ended(self, seconds: float) -> Iterator[Outcome]:
        """Give the outcomes of jobs that ended since, waiting for the first of them at most so long."""
        with contextlib.suppress(queue.Empty):
            key = self._ended.get(timeout=seconds) if seconds else self._ended.get_nowait()
            while True:
                yield outcome_of(*self._running.pop(key))
                self._feed()
                key = self._ended.get_nowait()
        self._feed()  # there may be more workers than before

    @property
    def running(self) -> list[Job]:
        """The jobs that workers have at the moment."""
        return [job for job, _ in self._running.values()]

    def stop(self) -> None:
        """Forget what waits, and ask what runs to save its state and end."""
        self._waiting.clear()
        self._client.run(_stop, self._token)

    def close(self) -> None:
        """End the workers of this machine, or let go of the cluster."""
        self._close.close()

    def _feed(self) -> None:
        """Give every worker a job."""
        if not self._waiting:
            return
        for _ in range(self.workers - len(self._running)):
            if not self._waiting:
                return
            job = self._waiting.popleft()
            key = f"{self._given}-{self._token}"  # not the directory's name, which several may share
            self._given += 1
            future = self._client.submit(_work, job, self._token, key=key, pure=False)
            self._running[key] = (job, future)
            future.add_done_callback(lambda done: self._ended.put(done.key))

    def _local(self, options: Options, jobs: int) -> Any:
        with _unheard():  # a new process inherits it, and is not stopped amid its imports
            return self._close.enter_context(
                LocalCluster(
                    n_workers=options.processes(jobs),
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=options.memory,
                    dashboard_address=None if options.dashboard is None else f":{options.dashboard}",
                    silence_logs=logging.CRITICAL,
                )
            )

    def _check(self, address: str, root: Path) -> None:
        """Refuse a cluster whose workers have another simpel, or do not see the directory of the sweep."""
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as error:
            raise ConfigError(
                f"hydra.launcher.address: the scheduler at {address} has no worker. Start one: "
                f"`dask worker {address} --nthreads 1`."
            ) from error
        (root / f".seen-{self._token}").touch()
        try:
            found = self._client.run(_look, str(root / f".seen-{self._token}"), on_error="return")
        finally:
            (root / f".seen-{self._token}").unlink()
        own = metadata.version("simpel")
        for worker, answer in found.items():
            if isinstance(answer, Exception):
                raise ConfigError(
                    f"hydra.launcher.address: the worker {worker} cannot run simpel ({type(answer).__name__}: {answer}). "
                    "Install simpel in its environment, or start it with another Python."
                )
            version, sees = answer
            if version != own:
                raise ConfigError(
                    f"hydra.launcher.address: the worker {worker} has simpel {version}, this is {own}. Install the same."
                )
            if not sees:
                raise ConfigError(
                    f"hydra.launcher.address: the worker {worker} does not see {root}. Put the sweep on a shared folder: "
                    "hydra.sweep.dir=DIR."
                )


class _Deaf(WorkerPlugin):
    """Plug-in of a worker of this machine: a terminal's Ctrl-C reaches it, too, and is for the sweep to act on."""

    def setup(self, worker: Any) -> None:
        import signal

        signal.signal(signal.SIGINT, signal.SIG_IGN)


_stops: dict[str, threading.Event] = {}  # of this worker, by sweep


def _work(job: Job, token: str) -> Outcome:
    """Run a job in a worker."""
    return perform(job, _stops.setdefault(token, threading.Event()))


def _stop(token: str) -> None:
    """Ask a worker to end what it does for a sweep."""
    _stops.setdefault(token, threading.Event()).set()


def _look(path: str) -> tuple[str, bool]:
    """Return a worker's version of simpel, and whether it sees a file."""
    import simpel_cli.sweeps.job  # noqa: F401

    return metadata.version("simpel"), Path(path).exists()


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """Take no notice of Ctrl-C within."""
    import signal

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory() -> float:
    from distributed.system import MEMORY_LIMIT

    return float(MEMORY_LIMIT)
