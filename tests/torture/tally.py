"""What a campaign came to: tries, losses, tracebacks, exact resumes; a table of it."""

import os
import random
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

NETWORKS = (
    "method.particles=4", "method.network.hidden=[16,16]", "method.pool=64", "method.sets=16", "prior.draws=64",
    "run.quiet=true",
)  # fmt: skip
SMALL = ("experiment=pendulum", "method.steps=3000", *NETWORKS)
PATIENCE = 900.0  # s for a process that hangs
TRACEBACK = "Traceback (most recent call last)"


@dataclass
class Row:
    """One line of the table.

    Args:
        name: what was done to it.
        tries: how often.
        hit: how often it was in time: killed before it had ended, for instance.
        losses: something was lost, or half a file lay under its name.
        tracebacks: shown to the user.
        resumed, exact: runs that were gone on with, and those of them with the result of a run that was left alone.
        notes: of what went wrong, for a person to look at.
    """

    name: str
    tries: int = 0
    hit: int = 0
    losses: int = 0
    tracebacks: int = 0
    resumed: int = 0
    exact: int = 0
    notes: list[str] = field(default_factory=list)

    def look(self, err: str, what: str) -> None:
        """Count a traceback."""
        if TRACEBACK in err:
            self.tracebacks += 1
            self.notes.append(f"{what}: {err.strip().splitlines()[-1]}")

    def lose(self, what: str) -> None:
        """Count a loss."""
        self.losses += 1
        self.notes.append(what)


def table(rows: Sequence[Row]) -> list[str]:
    """Return the table as Markdown, and what went wrong."""
    head = ("what", "tries", "in time", "losses", "tracebacks", "resumed", "exact")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        cells = (row.name, row.tries, row.hit, row.losses, row.tracebacks, row.resumed, row.exact)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return [*lines, "", *(f"* {row.name}: {note}" for row in rows for note in row.notes)]


def command(cwd: Path, words: Sequence[object], **options: object) -> subprocess.Popen[str]:
    """Start simpel as a process of its own, with a core of its own and a cache that campaigns share."""
    argv = [sys.executable, "-m", "simpel_cli.main", *map(str, words)]
    pipes: dict[str, object] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    pipes["env"] = os.environ | {"PYTHONWARNINGS": "default"}
    return subprocess.Popen(argv, cwd=cwd, **(pipes | options))


def finish(child: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Wait for a process; returns exit code and what it said."""
    out, err = child.communicate(timeout=PATIENCE)
    return child.returncode, out, err


def run(cwd: Path, words: Sequence[object], **options: object) -> tuple[int, str, str]:
    """Run simpel to its end."""
    return finish(command(cwd, words, **options))


def moments(seed: int) -> random.Random:
    """Return where random moments come from."""
    return random.Random(seed)


def fit_in(out: Path) -> Path:
    """Return the directory of a fit that was left alone, made where it is not there."""
    fitted = out / "fitted"
    if not (fitted / "report.html").exists():
        code, _, err = run(out, ("fit", *SMALL, f"hydra.run.dir={fitted}"))
        assert code == 0, err
    return fitted
