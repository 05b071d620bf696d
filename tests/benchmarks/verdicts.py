"""Time and memory of a verdict: `python -m tests.benchmarks.verdicts [--only hidden_pendulum ...]`.

Every search runs as a user would run it, twice: with an empty cache of compiled programs, and with the one that it left.
The recordings need SIMPEL_SHARED.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

SEARCHES = {
    "hidden_pendulum": ("2 states, 8 x 121 rows", ()),
    "hidden_cart": ("2 states, 8 x 301 rows", ()),
    "rc_car_bicycle": ("4 states, 3000 rows", ("effect=[vehicle]",)),
    "rc_car": ("6 states, 1500 rows", ("discovery.rows=1500",)),
}
MIB = 1024  # KiB, in which Linux counts what a process had in memory at most


def search(name: str, words: tuple[str, ...], directory: Path, cache: Path) -> dict[str, Any]:
    """Run one search; return seconds of the process and of the search, and the most memory that it had, MiB."""
    command = [sys.executable, "-m", "simpel_cli.main", "discover", f"experiment={name}", "close=false", *words]
    process = subprocess.Popen(
        [*command, f"hydra.run.dir='{directory}'"], env=os.environ | {"XDG_CACHE_HOME": str(cache)},
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{name} failed; its output is in {directory}/run.log")
    found = json.loads((directory / "verdict.json").read_text())
    return {
        "search": name,
        "verdict": found["verdict"],
        "seconds": found["seconds"],
        "cpu_seconds": used.ru_utime + used.ru_stime,
        "memory_mib": used.ru_maxrss / MIB,
        "candidates": found["candidates_tried"],
    }


def main() -> None:
    """Run the searches and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.verdicts", description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(SEARCHES), choices=SEARCHES)
    options = parser.parse_args()
    print(
        "| search | size | programs | seconds | CPU seconds | memory MiB | candidates |\n|---|---|---|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only:
            size, words = SEARCHES[name]
            for programs in ("compiled anew", "cached"):
                r = search(name, words, Path(scratch) / name / programs.split()[0], Path(scratch) / "cache" / name)
                print(
                    f"| {name} | {size} | {programs} | {r['seconds']:.0f} | {r['cpu_seconds']:.0f} | {r['memory_mib']:.0f} | "
                    f"{r['candidates']} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
