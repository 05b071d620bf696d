"""What a verb does with a job, or with the directory of one that was interrupted: its work, and the screen for people.

The command line and the jobs of a sweep start the same functions. Each imports what it needs when it is called.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from simpel_cli.config.compose import Job


def fit(job: Job) -> None:
    """Fit, see `studies.fit`."""
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.studies.fit import fit as work

    work(job, SCREEN)


def resume_fit(directory: Path) -> None:
    """Go on with a fit."""
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.studies.fit import resume

    resume(directory, SCREEN)


def evaluate(job: Job) -> None:
    """Judge a fit, see `studies.evaluate`."""
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.studies.evaluate import evaluate as work

    work(job, SCREEN)


def discover(job: Job, *, strict: bool = False) -> None:
    """Search for what the simulator lacks, see `discovery.run`."""
    from simpel_cli.discovery.run import discover as work
    from simpel_cli.reporting.discover import publish

    work(job, publish, strict=strict)


def rl_offline(job: Job) -> None:
    """Learn a policy from measurements, see `control.offline`."""
    from simpel_cli.control.offline import rl_offline as work
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.reporting.offline import publish

    work(job, SCREEN, publish)


def resume_rl_offline(directory: Path) -> None:
    """Go on with it."""
    from simpel_cli.control.offline import resume
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.reporting.offline import publish

    resume(directory, SCREEN, publish)


def rl_online(job: Job) -> None:
    """Learn a policy from episodes of its own, see `control.online`."""
    from simpel_cli.control.online import rl_online as work
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.reporting.online import publish

    work(job, SCREEN, publish)


def resume_rl_online(directory: Path, overrides: Sequence[str] = ()) -> None:
    """Go on with it, perhaps with more episodes."""
    from simpel_cli.control.online import resume
    from simpel_cli.reporting.fit import SCREEN
    from simpel_cli.reporting.online import publish

    resume(directory, SCREEN, publish, overrides)


# of the verbs that are swept
STARTS: dict[str, Callable[[Job], None]] = {
    "fit": fit, "discover": discover, "rl-offline": rl_offline, "rl-online": rl_online,
}  # fmt: skip
RESUMES: dict[str, Callable[..., Any]] = {
    "fit": resume_fit, "rl-offline": resume_rl_offline, "rl-online": resume_rl_online,
}  # fmt: skip
