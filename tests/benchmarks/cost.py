"""Run the command line in a process of its own and measure what it costs."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MIB = 1024  # KiB, in which Linux counts what a process had in memory at most
FILE = "cost.json"


def searched(
    words: Sequence[str], directory: Path, environment: Mapping[str, str] | None = None, checkout: Path | None = None
) -> dict[str, Any]:
    """Run `simpel discover`, unless that was done, and return its verdict with what the process cost under `cost`.

    Args:
        words: of the command line.
        directory: of the run.
        environment: variables that are set.
        checkout: of the version that runs; None: where the caller is.

    Raises:
        SystemExit: it failed.
    """
    if not (directory / FILE).exists() and (directory / "verdict.json").exists():
        raise SystemExit(f"{directory} holds a verdict without its cost ({FILE}); remove it, or choose another --out")
    if not (directory / FILE).exists():
        command = [sys.executable, "-m", "simpel_cli.main", "discover", *words, f"hydra.run.dir='{directory}'"]
        cost = of_process(command, environment, checkout)
        if cost is None:
            raise SystemExit(f"simpel discover {' '.join(words)} failed; what it said is in {directory}/run.log")
        (directory / FILE).write_text(json.dumps(cost))
    return json.loads((directory / "verdict.json").read_text()) | {"cost": json.loads((directory / FILE).read_text())}


def of_process(
    command: Sequence[str], environment: Mapping[str, str] | None = None, folder: Path | None = None
) -> dict[str, float] | None:
    """Run a command and return what its process cost, `cpu_seconds` and `memory_mib`; None: it failed.

    Args:
        command: with its arguments.
        environment: variables that are set.
        folder: where it runs; None: where the caller is.
    """
    process = subprocess.Popen(command, env=os.environ | dict(environment or {}), stdout=subprocess.DEVNULL, cwd=folder)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        return None
    return {"cpu_seconds": used.ru_utime + used.ru_stime, "memory_mib": used.ru_maxrss / MIB}
