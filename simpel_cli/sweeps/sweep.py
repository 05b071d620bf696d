"""`simpel sweep`, and `-m` of every verb: run every combination of values, collect what is complete.

Hydra composes the jobs. Its launcher `dask` hands them to workers of `sweeps.workers`; any other launcher of Hydra runs
each where it likes, and finds the same `perform`. A job that fails, or a worker that dies, costs that job only.
"""

import contextlib
import os
import threading
from pathlib import Path
from time import perf_counter
from typing import Any

from simpel_cli.config.compose import Job, launch, sweep_directory
from simpel_cli.config.hydra_launcher import DaskLauncher
from simpel_cli.config.overrides import count_jobs, first_job, value_of
from simpel_cli.errors import ConfigError, Interrupted, SimpelError
from simpel_cli.runs.console import Board, Terminal
from simpel_cli.runs.directory import typed
from simpel_cli.runs.finding import Found, runs_below
from simpel_cli.runs.interruption import interruption
from simpel_cli.runs.lock import locked
from simpel_cli.sweeps.collect import RECORD, Record, collect, headline, read_record, write_record
from simpel_cli.sweeps.job import Outcome, perform

LOOK = 0.2  # s between two looks at what has ended
GRACE = 300.0  # s that running jobs have to save their state


class Sweep:
    """Queues jobs, shows how they end, and keeps the outcomes.

    Args:
        record: of the sweep.
        terminal: where a line per job goes.
        stop: set when the user wants it to end.
    """

    def __init__(self, record: Record, terminal: Terminal, stop: threading.Event) -> None:
        self.record, self.terminal, self.stop = record, terminal, stop
        self.outcomes: list[Outcome] = []
        self.root: Path | None = None
        self._cluster: Any = None
        self._queued = 0
        self._began = perf_counter()
        self._board = Board(terminal)
        self._open = contextlib.ExitStack()

    def add(self, job: Job) -> None:
        """Queue a job.

        Raises:
            Interrupted: the user stopped the sweep.
            ConfigError: the workers cannot be had, or another process is at work in the directory.
        """
        if self._cluster is None:
            self._start(job)
        self._cluster.submit(job)
        self._queued += 1
        self._look(0.0)

    def wait(self) -> None:
        """Wait until every queued job has ended.

        Raises:
            Interrupted: the user stopped the sweep.
        """
        while len(self.outcomes) < self._queued:
            self._look(LOOK)

    def close(self) -> None:
        """End the workers."""
        self._open.close()

    def _start(self, job: Job) -> None:
        from simpel_cli.sweeps.workers import Cluster, Options

        options = Options.of(job.launcher)
        assert job.sweep is not None
        self.root = job.sweep
        self._open.enter_context(contextlib.closing(locked(self.root)))
        write_record(self.root, self.record)
        self._cluster = Cluster(options, self.record.jobs, self.root)
        self._open.enter_context(contextlib.closing(self._cluster))
        self._open.enter_context(self._board)
        count = self._cluster.workers
        where = f"at {options.address}" if options.address else "on this machine"
        self.terminal.line(f"{count} {'worker' if count == 1 else 'workers'} {where}", "workers")
        if self._cluster.dashboard:
            self.terminal.line(self._cluster.dashboard, "dashboard")
        self._began = perf_counter()

    def _look(self, seconds: float) -> None:
        for outcome in self._cluster.ended(seconds):
            self.outcomes.append(outcome)
            self._say(outcome)
        self._board.show(self._running)
        if self.stop.is_set():
            self._end()

    def _end(self) -> None:
        """Stop what runs, so that it can be gone on with."""
        self.terminal.line("stopping: running jobs save their state", style="yellow")
        self._cluster.stop()
        end = perf_counter() + GRACE
        while self._cluster.running and perf_counter() < end:
            self.outcomes += self._cluster.ended(LOOK)
        raise Interrupted(
            f"the sweep was stopped; finished jobs are kept. `simpel sweep --resume {typed(self.root or 'DIR')}` goes on."
        )

    def _say(self, outcome: Outcome) -> None:
        done, total = len(self.outcomes), self.record.jobs
        if outcome.code:
            what = f"error: {outcome.error}"
        elif not outcome.seconds:
            what = "done before"
        else:
            what = headline(outcome.directory)
        took = f"{outcome.seconds:.0f} s" + (" since its worker died or it was stopped" if outcome.resumed else "")
        self.terminal.line(
            "  ".join(
                filter(None, (f"{done}/{total}", outcome.words, what, took if outcome.seconds else "", self._left()))
            ),
            style="red" if outcome.code else "",
        )

    def _left(self) -> str:
        """Return about how long the rest takes."""
        ran = sum(outcome.seconds > 0 for outcome in self.outcomes)
        left = self.record.jobs - len(self.outcomes)
        if not ran or not left:
            return ""
        minutes = (perf_counter() - self._began) / ran * left / 60
        return f"about {minutes:.0f} min left" if minutes >= 1 else "less than a minute left"

    def _running(self) -> list[tuple[str, str]]:
        """Return what runs, for the board: words, and how far it is."""
        return [(job.words or job.directory.name, _progress(job)) for job in self._cluster.running]


def sweep(verb: str, overrides: list[str], config_dir: Path | None, cfg: str | None) -> None:
    """Run a new sweep and collect it.

    Raises:
        SimpelError: a job failed; everything else was collected, and the error says where.
    """
    if cfg:
        launch(_root_of(verb), perform, first_job(overrides), config_dir=config_dir, flags=["--cfg", cfg])
        return
    if (given := value_of("hydra.sweep.dir", overrides)) is not None:
        _refuse_occupied(Path(given))
    folder = str(config_dir.absolute()) if config_dir is not None else None
    _run(Record(verb, overrides, folder, count_jobs(overrides)), overrides)


def _refuse_occupied(root: Path) -> None:
    """Look into a directory that the user names before anything is written to it."""
    cure = "another directory; nothing was changed."
    if (root / RECORD).exists():
        raise ConfigError(
            f"hydra.sweep.dir: {root} holds a sweep already. Go on with `simpel sweep --resume {typed(root)}`, or choose {cure}"
        )
    if root.exists() and not root.is_dir():
        raise ConfigError(f"hydra.sweep.dir: {root} is a file. Choose {cure}")
    # jobs with a number are of the same command, given again: another launcher was killed before it left a record
    places = (run.directory for run in runs_below(root))
    other = next((place for place in places if place.parent != root or not place.name.isdigit()), None)
    if other is not None:
        raise ConfigError(
            f"hydra.sweep.dir: {root} holds other runs ({other}), which the sweep would take for its own. Choose {cure}"
        )


def resume(root: Path, overrides: list[str]) -> None:
    """Run what is missing or failed of a sweep; what is done is left as it is.

    Args:
        root: directory of the sweep.
        overrides: of the launcher; everything else is known.

    Raises:
        ConfigError: not a sweep, or overrides of something else.
    """
    record = read_record(root)
    for word in overrides:
        if not word.startswith(("hydra.launcher.", "hydra/launcher=", "run.quiet=")):
            raise ConfigError(
                f"--resume: {word} is not of the launcher; the jobs are those of {root / RECORD}. For others start a new sweep."
            )
    keys = {word.partition("=")[0] for word in [*overrides, "hydra.sweep.dir="]}
    other = "hydra/launcher" in keys  # the options of the one before are none of its
    kept = [
        word
        for word in record.words
        if word.partition("=")[0] not in keys and not (other and word.startswith("hydra.launcher."))
    ]
    _run(record, [*kept, *overrides, f"hydra.sweep.dir='{root.absolute()}'"])


def _run(record: Record, words: list[str]) -> None:
    terminal = Terminal((value_of("run.quiet", words) or "").lower() == "true")
    terminal.line(f"simpel sweep · {record.verb} · {record.jobs} {'job' if record.jobs == 1 else 'jobs'}", style="bold")
    folder = Path(record.config_dir) if record.config_dir else None
    left: list[Found] = []
    with interruption() as stop:
        own = Sweep(record, terminal, stop)
        DaskLauncher.chosen, DaskLauncher.queue = False, own.add
        try:
            launch(_root_of(record.verb), _queue_or_perform, words, config_dir=folder, flags=["-m"])
            own.wait()
        except SimpelError:
            raise
        except Exception as error:
            if DaskLauncher.chosen:
                raise
            raise SimpelError(  # somebody else's: what it was given, or where it runs jobs
                f"hydra/launcher={value_of('hydra/launcher', words)}: {type(error).__name__}: {error} "
                "`simpel sweep --resume DIR` goes on; hydra/launcher=dask, the default, needs nothing but this machine."
            ) from error
        finally:
            own.close()
            ours = DaskLauncher.chosen
            root = own.root if ours else sweep_directory()
            if root is not None and (own.outcomes or not ours):
                if not ours:
                    write_record(root, record)
                left = collect(root, record.words, terminal)
    _refuse_failed(own.outcomes, root)
    if left:  # where another launcher ran them, nothing else tells
        raise SimpelError(f"{len(left)} of {record.jobs} jobs are not done, the others are collected.")


def _queue_or_perform(job: Job) -> Any:
    """Take a job. Another launcher may carry this to another process: a plain function, without what holds workers."""
    return DaskLauncher.queue(job) if DaskLauncher.chosen else perform(job)


def _refuse_failed(outcomes: list[Outcome], root: Path | None) -> None:
    # in the order of the jobs, not in that in which they ended: job 10 after job 9
    failed = sorted((o for o in outcomes if o.code), key=lambda o: (len(str(o.directory)), str(o.directory)))
    if failed:
        names = "; ".join(f"{os.path.relpath(o.directory, root)}: {o.error}" for o in failed[:5])
        error = SimpelError(f"{len(failed)} of {len(outcomes)} jobs failed, the others are collected. {names}")
        error.exit_code = failed[0].code
        raise error


def _root_of(verb: str) -> str:
    """Return the name of the root configuration of a sweep of a verb."""
    return "sweep" if verb == "fit" else verb


def _progress(job: Job) -> str:
    """Return how far a job is, by its metrics: they are written as it goes."""
    path = job.directory / "metrics.jsonl"
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 4096))
            last = file.read().splitlines()[-2:]
    except (OSError, IndexError):
        return ""
    import json

    for line in reversed(last):
        with contextlib.suppress(ValueError):
            return f"step {json.loads(line)['step']}"
    return ""
