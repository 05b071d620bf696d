"""One job of a sweep, whatever its verb: run it here, or go on with it where it was, and note how it ended."""

import contextlib
import shutil
import threading
import traceback
from pathlib import Path
from time import perf_counter, sleep
from typing import Any, NamedTuple

from simpel_cli.config.compose import Job
from simpel_cli.config.places import with_place
from simpel_cli.config.resolved import of_run
from simpel_cli.errors import ConfigError, Interrupted, SimpelError
from simpel_cli.runs.console import silence
from simpel_cli.runs.finding import ASIDE
from simpel_cli.runs.interruption import interruption, stop_if
from simpel_cli.runs.lock import is_locked
from simpel_cli.runs.manifest import read_manifest
from simpel_cli.sweeps.verbs import RESUMES, STARTS

_one_at_a_time = threading.Lock()  # settings of JAX are those of the process


class Outcome(NamedTuple):
    """How a job ended."""

    directory: Path
    code: int  # exit code that the job would have had as a command
    error: str = ""
    words: str = ""  # the overrides that tell this job from the others
    seconds: float = 0.0
    resumed: bool = False  # it went on where a process before it had ended


def complete(job: Job) -> Outcome | None:
    """Return the outcome of a job that was done before; None: it is missing, failed or not finished.

    It is an error if it was done with another configuration.
    """
    try:
        record = read_manifest(job.directory)
    except ConfigError:
        return None
    if record.get("status") != "done":
        return None
    changed = _changed(job)
    if not changed:
        return Outcome(job.directory, 0, words=job.words)
    error = f"done before with another configuration ({changed}); for a new one start a new sweep"
    return Outcome(job.directory, ConfigError.exit_code, error, job.words)


def perform(job: Job, stop: threading.Event | None = None) -> Outcome:
    """Run a job in this process: what an earlier process left is gone on with, what failed is set aside and run anew.

    Args:
        job: of a sweep.
        stop: set by whoever wants it to save its state and end.
    """
    began = perf_counter()
    code, error, resumed = 0, "", False
    try:
        with _one_at_a_time, silence(), interruption(stop) as stopped:
            while is_locked(job.directory):  # by a worker that an earlier client of the cluster has left behind
                stop_if(stopped)
                sleep(1.0)
            if (before := complete(job)) is not None:
                return before
            resumed = _begun(job)
            if resumed:
                RESUMES[job.verb](job.directory)
            else:
                STARTS[job.verb](job)
    except SimpelError as failure:
        code, error = failure.exit_code, str(with_place(failure, job.layers, job.given))
    except KeyboardInterrupt:
        code, error = Interrupted.exit_code, "stopped"
    except Exception:  # whatever it is, it costs this job and no other; the traceback is kept beside it
        text = traceback.format_exc()
        job.directory.mkdir(parents=True, exist_ok=True)
        (job.directory / "traceback.txt").write_text(text)
        code, error = 1, f"{text.splitlines()[-1]} (see traceback.txt in its directory)"
    return Outcome(job.directory, code, error, job.words, perf_counter() - began, resumed)


def _begun(job: Job) -> bool:
    """Return whether there is something to go on with; what cannot be gone on with is set aside."""
    try:
        record = read_manifest(job.directory)
    except ConfigError:
        return False
    if job.verb in RESUMES and record.get("status") in ("running", "interrupted"):
        with contextlib.suppress(ConfigError):  # a configuration that this version cannot read is another one
            if not _changed(job):
                return True
    _set_aside(job.directory)
    return False


def _set_aside(directory: Path) -> None:
    """Move what a failed job left, but for Hydra's record of this one."""
    number = 1
    while (aside := directory.with_name(f"{directory.name}{ASIDE}{number}")).exists():
        number += 1
    aside.mkdir()
    for path in list(directory.iterdir()):
        if path.name == ".hydra":
            shutil.copytree(path, aside / path.name)
        else:
            path.rename(aside / path.name)


def _changed(job: Job) -> str:
    """Return what the configuration in the directory has otherwise than the job; empty: nothing that changes a result."""
    from simpel_cli.studies.declared import resolved

    own = {"quiet", "cache", "device"}
    if job.verb == "discover":
        own.add("precision")  # it has one of its own

    def plain(config: dict[str, Any]) -> dict[str, Any]:
        return config | {"run": {k: v for k, v in (config.get("run") or {}).items() if k not in own}}

    return _difference(plain(of_run(job.directory)), plain(resolved(job)))


def _difference(old: Any, new: Any, path: str = "") -> str:
    """Return the first key with another value, and both; empty: there is none."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*new, *(k for k in old if k not in new)]:
            if found := _difference(old.get(key), new.get(key), f"{path}.{key}" if path else str(key)):
                return found
        return ""
    if isinstance(old, list | tuple) and isinstance(new, list | tuple) and len(old) == len(new):
        return next(
            (f for i, (a, b) in enumerate(zip(old, new, strict=True)) if (f := _difference(a, b, f"{path}.{i}"))), ""
        )
    return "" if old == new else f"{path}: {old}, now {new}"
