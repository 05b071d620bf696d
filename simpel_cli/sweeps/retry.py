"""Retries: a job whose worker died is given to another one; it goes on with what the first has left."""

from typing import Any

from simpel_cli.config.compose import Job
from simpel_cli.sweeps.job import Outcome

RETRIES = 1  # of a job whose worker died; a job that fails by itself is not retried

# Dask's scheduler counts the deaths of a job's workers and gives the job to another worker so many times
SCHEDULER = {"distributed.scheduler.allowed-failures": RETRIES}


def outcome_of(job: Job, future: Any) -> Outcome:
    """Return how a job ended whose future is done: its own outcome, or why no worker brought it to an end."""
    error = future.exception()
    if error is None:
        found: Outcome = future.result()
        return found
    if type(error).__name__ == "KilledWorker":
        text = f"its worker died {RETRIES + 1} times (out of memory, or killed)"
    else:
        text = f"{type(error).__name__}: {error}"
    return Outcome(job.directory, 1, text, job.words)
