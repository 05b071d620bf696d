"""`simpel sweep`: fit every combination of values through Hydra's multirun, collect what is complete.

Jobs run one after another in a worker process that is kept, so that imports and compiled programs are shared. A job
that fails, or a worker that dies, costs that job only.
"""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from simpel_cli.config import Job, count_jobs, launch
from simpel_cli.console import Terminal
from simpel_cli.errors import Interrupted, SimpelError
from simpel_cli.plots import draw_sweep
from simpel_cli.records import read_metrics, write_metrics
from simpel_cli.run import read_manifest


class Outcome(NamedTuple):
    """How a job ended."""

    directory: Path
    code: int  # exit code that the job would have had as a command
    error: str
    words: str = ""  # the overrides that tell this job from the others


class Jobs:
    """Runs jobs in a worker process and replaces the worker when it dies.

    Args:
        total: number of jobs of the sweep.
        terminal: where a line per job goes.
    """

    def __init__(self, total: int, terminal: Terminal) -> None:
        self.total, self.terminal = total, terminal
        self.outcomes: list[Outcome] = []
        self._pool: ProcessPoolExecutor | None = None
        self._began = perf_counter()

    def run(self, job: Job) -> None:
        """Run one job and note how it ended; raises only when the user stops the sweep."""
        quiet = job._replace(config=job.config | {"run": (job.config.get("run") or {}) | {"quiet": True}})
        began = perf_counter()
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=_begin)
        with _without_ctrl_c():  # a new process inherits it, and is not stopped amid its imports
            future = self._pool.submit(_work, quiet)
        try:
            outcome = future.result()
        except BrokenProcessPool:
            self._pool = None
            outcome = Outcome(job.directory, 1, "the worker process died (out of memory, or killed)")
        except KeyboardInterrupt:
            # the worker got the same Ctrl-C: it saves its state at the end of its stretch
            with contextlib.suppress(BrokenProcessPool, KeyboardInterrupt):
                self.outcomes.append(future.result(timeout=60))
            raise Interrupted("the sweep was stopped; finished jobs are kept.") from None
        outcome = outcome._replace(words=job.words)
        self.outcomes.append(outcome)
        self._say(job, outcome, perf_counter() - began)
        if outcome.code == Interrupted.exit_code:
            raise Interrupted("the sweep was stopped; finished jobs are kept.")

    def close(self) -> None:
        """End the worker."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _say(self, job: Job, outcome: Outcome, seconds: float) -> None:
        done = len(self.outcomes)
        left = (perf_counter() - self._began) / done * (self.total - done)
        what = f"error: {outcome.error}" if outcome.code else _result(outcome.directory)
        self.terminal.line(
            f"{done}/{self.total}  {job.words}  {what}  {seconds:.0f} s, about {left / 60:.0f} min left",
            style="red" if outcome.code else "",
        )


def sweep(overrides: list[str], config_dir: Path | None, cfg: str | None) -> None:
    """Run the sweep and collect it.

    Raises:
        SimpelError: a job failed; everything else was collected, and the error says where.
    """
    total = count_jobs(overrides)
    quiet = any(o.replace(" ", "").lower() == "run.quiet=true" for o in overrides)
    terminal = Terminal(quiet)
    jobs = Jobs(total, terminal)
    if not cfg:
        terminal.line(f"simpel sweep · {total} jobs", style="bold")
    try:
        launch("sweep", jobs.run, overrides, config_dir=config_dir, flags=["--cfg", cfg] if cfg else ["-m"])
    finally:
        jobs.close()
        if jobs.outcomes:
            _collect(jobs.outcomes, terminal)
    failed = [o for o in jobs.outcomes if o.code]
    if failed:
        names = "; ".join(f"{o.directory.name}: {o.error}" for o in failed[:5])
        error = SimpelError(f"{len(failed)} of {len(jobs.outcomes)} jobs failed, the others are collected. {names}")
        error.exit_code = failed[0].code
        raise error


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Take no notice of Ctrl-C within."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _begin() -> None:
    """Prepare the worker process: it stops with its parent, however that ends."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)  # amid a job: its state is saved first

    threading.Thread(target=watch, daemon=True).start()


def _leave_orphaned() -> None:
    """End this process if nobody is left to give it jobs: it would wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():
        os._exit(Interrupted.exit_code)


def _work(job: Job) -> Outcome:
    """Fit in the worker process."""
    from simpel_cli.commands.fit import fit
    from simpel_cli.loop import interruption

    try:
        # Ctrl-C reaches this process too; an exception raised anywhere might be lost in a callback of a library
        with interruption():
            fit(job)
    except SimpelError as error:
        return Outcome(job.directory, error.exit_code, str(error))
    except Exception:  # whatever it is, it costs this job and no other; the traceback is kept beside it
        text = traceback.format_exc()
        job.directory.mkdir(parents=True, exist_ok=True)
        (job.directory / "traceback.txt").write_text(text)
        return Outcome(job.directory, 1, f"{text.splitlines()[-1]} (see traceback.txt in its directory)")
    finally:
        _leave_orphaned()
    return Outcome(job.directory, 0, "")


def _collect(outcomes: list[Outcome], terminal: Terminal) -> None:
    """Write `sweep.parquet` of the finished jobs and draw the figure."""
    root = outcomes[0].directory.parent
    rows: list[dict[str, Any]] = []
    for outcome in outcomes:
        with contextlib.suppress(SimpelError):
            if read_manifest(outcome.directory)["status"] == "done":
                found = read_metrics(outcome.directory / "metrics.parquet")
                name = outcome.words or outcome.directory.name
                rows += [row | {"run": name} for row in found if row["split"] == "test"]
    if not rows:
        return
    path = write_metrics(root / "sweep.parquet", rows, {})
    terminal.line()
    terminal.line(str(path), "results")
    figure = draw_sweep(path)
    if figure is not None:
        terminal.line(str(figure), "figure")


def _result(directory: Path) -> str:
    """Joint test NLL and error of a finished job; the error has no unit, since a joint one may have several."""
    rows = read_metrics(directory / "metrics.parquet")
    shown = []
    for metric, name in (("nll", "NLL"), ("nrmse", "normalised RMSE")):
        values = [r["value"] for r in rows if r["metric"] == metric and r["output"] == "joint"]
        shown.append(f"{name} {sum(values) / len(values):.3g}")
    return "  ".join(shown)
